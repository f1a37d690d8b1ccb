"""SCENE/offset.json."""

import json
from pathlib import Path

import pytest

from panolog.scene.errors import InputError
from panolog.scene.offset import Offset, Origin, read_offset, write_offset

ENU = {"frame": "ENU", "origin": {"latitude": 47.5, "longitude": -8.25, "altitude": 431.0}}


def test_without_a_file_there_is_nothing_to_add(tmp_path: Path) -> None:
    assert read_offset(tmp_path) is None


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
def test_comes_back_as_it_was_written(tmp_path: Path, offset: Offset) -> None:
    write_offset(tmp_path, offset)
    assert read_offset(tmp_path) == offset
    assert [path.name for path in tmp_path.iterdir()] == ["offset.json"]


def test_what_is_written(tmp_path: Path) -> None:
    """The format that docs/import.md shows; numbers may be whole."""
    write_offset(tmp_path, Offset(offset=(1.0, 2.0, 3.5)))
    assert json.loads((tmp_path / "offset.json").read_text()) == {"offset": [1, 2, 3.5]}
    (tmp_path / "offset.json").write_text(json.dumps({"offset": [1, 2, 3], **ENU}))
    found = read_offset(tmp_path)
    assert found is not None
    assert found.origin is not None
    assert (found.offset, found.origin.altitude) == ((1, 2, 3), 431)


@pytest.mark.parametrize(
    ("content", "field"),
    [
        (b"", "JSON"),
        (b"\xff\xfe{", "JSON"),
        (b"[" * 60_000, "JSON"),
        (b"[]", "object"),
        (b" " * 70_000, "65536 bytes"),
        ({}, "offset: "),
        ({"offset": [1, 2]}, "offset"),
        ({"offset": [1, 2, "3"]}, "offset.2"),
        ({"offset": [1, 2, 1e300]}, "offset.2"),
        (b'{"offset": [1, 2, NaN]}', "offset.2"),
        ({"offset": [1, 2, 3], "scale": 1}, "scale"),
        ({"offset": [1, 2, 3], "frame": "ENU"}, "frame and origin"),
        ({"offset": [1, 2, 3], **ENU, "frame": "UTM"}, "frame"),
        ({"offset": [1, 2, 3], **ENU, "origin": {**ENU["origin"], "latitude": 91}}, "origin.latitude"),  # type: ignore[dict-item]
        ({"offset": [1, 2, 3], **ENU, "origin": {"latitude": 1, "longitude": 1}}, "origin.altitude"),
    ],
)
def test_what_is_damaged_is_named(tmp_path: Path, content: object, field: str) -> None:
    data = content if isinstance(content, bytes) else json.dumps(content).encode()
    (tmp_path / "offset.json").write_bytes(data)
    with pytest.raises(InputError) as error:
        read_offset(tmp_path)
    assert str(error.value).startswith(f"{tmp_path / 'offset.json'}: ")
    assert field in str(error.value)
    assert "\n" not in str(error.value)
