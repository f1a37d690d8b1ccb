"""SCENE/offset.json."""

import json
from pathlib import Path

import pytest

from panolog.scene.errors import SceneError
from panolog.scene.write import Offset, Origin, read_offset, write_offset

ORIGIN = {"latitude": 47.5, "longitude": -8.250000001, "altitude": 431.0}
ENU = {"frame": "ENU", "origin": ORIGIN}


@pytest.mark.parametrize(
    ("offset", "content"),
    [
        (Offset(offset=(512_345.0, 5_403_210.25, -300.0)), {"offset": [512_345, 5_403_210.25, -300]}),
        (
            Offset(offset=(0.0, 0.0, 3.5), frame="ENU", origin=Origin(**ORIGIN)),
            {"offset": [0, 0, 3.5], **ENU},
        ),
    ],
)
def test_the_file_holds_the_offset_exactly(tmp_path: Path, offset: Offset, content: object) -> None:
    """The format that docs/import.md shows; numbers may be whole."""
    assert read_offset(tmp_path) is None
    write_offset(tmp_path, offset)
    assert read_offset(tmp_path) == offset
    assert json.loads((tmp_path / "offset.json").read_text()) == content
    assert [path.name for path in tmp_path.iterdir()] == ["offset.json"]
    (tmp_path / "offset.json").write_text(json.dumps(content))
    assert read_offset(tmp_path) == offset


@pytest.mark.parametrize(
    ("content", "field"),
    [
        ({}, "offset: "),
        ({"offset": [1, 2, 1e300]}, "offset.2: "),
        ({"offset": [1, 2, float("nan")]}, "offset.2: "),
        ({"offset": [1, 2, 3], "scale": 1}, "scale: "),
        ({"offset": [1, 2, 3], "epsg": 0}, "epsg: "),
        ({"offset": [1, 2, 3], "frame": "ENU"}, "frame and origin belong together"),
        ({"offset": [1, 2, 3], **ENU, "epsg": 32632}, "the source's coordinates"),
        ({"offset": [1, 2, 3], **ENU, "origin": ORIGIN | {"latitude": 91}}, "origin.latitude: "),
    ],
)
def test_what_is_no_offset_is_one_line(tmp_path: Path, content: object, field: str) -> None:
    (tmp_path / "offset.json").write_text(json.dumps(content))
    with pytest.raises(SceneError) as error:
        read_offset(tmp_path)
    assert str(error.value).startswith(f"{tmp_path}/offset.json: {field}") and "\n" not in str(error.value)


def test_an_offset_that_cannot_be_read(tmp_path: Path) -> None:
    (tmp_path / "offset.json").mkdir()
    with pytest.raises(SceneError, match="cannot be read: Is a directory"):
        read_offset(tmp_path)
