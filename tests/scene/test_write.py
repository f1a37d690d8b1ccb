"""SCENE/offset.json."""

import json
from pathlib import Path

import pytest
from pydantic import ValidationError

from panolog.scene.write import Offset, Origin, write_offset

ENU = {"frame": "ENU", "origin": {"latitude": 47.5, "longitude": -8.25, "altitude": 431.0}}


@pytest.mark.parametrize(
    "offset",
    [
        Offset(offset=(512_345.0, 5_403_210.25, -300.0)),
        Offset(
            offset=(0.0, 0.0, 0.0),
            frame="ENU",
            origin=Origin(latitude=-33.123456789, longitude=179.987654321, altitude=-12.5),
        ),
    ],
)
def test_the_file_holds_the_offset_exactly(tmp_path: Path, offset: Offset) -> None:
    write_offset(tmp_path, offset)
    assert Offset.model_validate_json((tmp_path / "offset.json").read_bytes()) == offset
    assert [path.name for path in tmp_path.iterdir()] == ["offset.json"]


def test_what_is_written(tmp_path: Path) -> None:
    """The format that docs/import.md shows; numbers may be whole."""
    write_offset(tmp_path, Offset(offset=(1.0, 2.0, 3.5)))
    assert json.loads((tmp_path / "offset.json").read_text()) == {"offset": [1, 2, 3.5]}
    whole = Offset.model_validate_json(json.dumps({"offset": [1, 2, 3], **ENU}))
    assert whole.origin is not None
    assert (whole.offset, whole.origin.altitude) == ((1, 2, 3), 431)


@pytest.mark.parametrize(
    ("content", "field"),
    [
        ({}, "offset"),
        ({"offset": [1, 2]}, "offset.2"),
        ({"offset": [1, 2, "3"]}, "offset.2"),
        ({"offset": [1, 2, 1e300]}, "offset.2"),
        ({"offset": [1, 2, float("nan")]}, "offset.2"),
        ({"offset": [1, 2, 3], "scale": 1}, "scale"),
        ({"offset": [1, 2, 3], "frame": "ENU"}, ""),
        ({"offset": [1, 2, 3], **ENU, "frame": "UTM"}, "frame"),
        ({"offset": [1, 2, 3], **ENU, "origin": {**ENU["origin"], "latitude": 91}}, "origin.latitude"),  # type: ignore[dict-item]
        ({"offset": [1, 2, 3], **ENU, "origin": {"latitude": 1, "longitude": 1}}, "origin.altitude"),
    ],
)
def test_what_is_no_offset_is_refused(content: object, field: str) -> None:
    with pytest.raises(ValidationError) as error:
        Offset.model_validate_json(json.dumps(content))
    assert field in {".".join(map(str, item["loc"])) for item in error.value.errors()}
