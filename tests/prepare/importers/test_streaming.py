"""Structure of any length is read in pieces, and what is hostile in it takes no memory."""

import json
import tracemalloc
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from panolog.prepare.importers import json_xml
from panolog.prepare.importers.interface import ImportSource
from panolog.prepare.importers.json_xml import JsonNode, load_json_in_pieces
from panolog.prepare.importers.openmvg import _OBSERVATION, _Structure
from panolog.prepare.importers.opensfm import read as read_opensfm
from panolog.prepare.importers.point_cloud import read_point_cloud
from panolog.scene.errors import InputError
from tests.prepare.importers.files import write_json
from tests.prepare.importers.writers import opensfm

LIST: list[Any] = [1, -2.5e3, True, None, 'a"]}é𝄞\\', [], {}, [[1, 2], {"b": [3]}], {"x": {"y": "z" * 300}}]


def pieces(path: Path, memory: int = 10**8) -> tuple[Any, list[Any]]:
    found: list[JsonNode] = []
    rest = load_json_in_pieces(path, "many", found.append, memory)
    assert [node.field for node in found] == [f"many[{index}]" for index in range(len(found))]
    return rest.value, [node.value for node in found]


@pytest.mark.parametrize("chunk", [1, 2, 3, 7, 64, 2**20])
@pytest.mark.parametrize("indent", [None, 4])
def test_pieces_are_the_whole(
    chunk: int, indent: int | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(json_xml, "_CHUNK", chunk)
    monkeypatch.setattr(json_xml, "_AHEAD", max(1, chunk // 2))
    path = tmp_path / "x.json"
    content = {"first": {"a": [1, 2]}, "many": LIST, "é": "last", "number": 12345.678}
    path.write_text("\ufeff\n " + json.dumps(content, indent=indent, ensure_ascii=False) + "\n ")
    assert pieces(path) == ({"first": {"a": [1, 2]}, "é": "last", "number": 12345.678}, LIST)
    nothing: list[dict[str, Any]] = [{}, {"many": []}, {"many": {"a": 1}}, {"other": 1}]
    for none in nothing:
        write_json(path, none)
        assert pieces(path) == ({key: value for key, value in none.items() if value != []}, [])


@pytest.mark.parametrize(
    "text",
    [
        "",
        "{}x",
        '{"many": [1, 2}',
        '{"many": [1 2]}',
        '{"many": [1, 2], }',
        '{"many": [1, nul',
        '{"many": [NaN]}',
        '{"many" 1}',
        "{1: 2}",
        '{"many": [' + "[" * 100_000,
        '{"many": ' + "[" * 100_000,
        '{"a": ' + '{"a": ' * 100_000,
        '{"many": [' + "9" * 5_000 + "]}",
        '{"many": ["\xff\xfe"]}',
    ],
)
def test_what_is_no_json(text: str, tmp_path: Path) -> None:
    path = tmp_path / "x.json"
    path.write_text(text, encoding="latin-1")
    with pytest.raises(InputError, match=r"x\.json: (is not JSON \(.+\)|an object)") as error:
        pieces(path)
    assert "\n" not in str(error.value) and len(str(error.value)) < 300


@pytest.mark.parametrize(
    "text",
    [
        '{"many": ["' + "x" * 5_000_000 + '"]}',  # a member that is too long
        '{"many": [' + "[" + "[]," * 1_000_000 + "[]]]}",
        '{"a": ' + "[" + "{}," * 1_000_000 + "{}]}",
        "{" + ",".join(f'"{i}": [[],[],[],[],[],[],[],[]]' for i in range(100_000)) + "}",
        '{"' + "x" * 5_000_000,
    ],
)
def test_what_is_too_large_takes_no_memory(text: str, tmp_path: Path) -> None:
    path = tmp_path / "x.json"
    path.write_text(text)
    del text
    tracemalloc.start()
    with pytest.raises(InputError, match=r"x\.json: too large to be read with the memory that is free"):
        pieces(path, memory=3_000_000)
    assert tracemalloc.get_traced_memory()[1] < 30_000_000  # a piece of 1 MiB is parsed as it is
    tracemalloc.stop()


def test_a_mistake_is_found_where_it_is(tmp_path: Path) -> None:
    """Not by reading on to the end of the file, or of the memory."""
    path = tmp_path / "x.json"
    path.write_text('{"many": [1, {"a": oops}, ' + "[]," * 1_000_000 + "1]}")
    with pytest.raises(InputError, match=r"is not JSON \(Expecting value\)"):
        pieces(path, memory=8_000_000)


def test_a_long_list_takes_the_memory_of_its_members(tmp_path: Path) -> None:
    path, last = tmp_path / "x.json", dict[str, str]()
    path.write_text('{"many": [' + '{"key": 1, "value": [1.5, 2.5]},' * 30_000 + "{}]}")
    tracemalloc.start()
    load_json_in_pieces(path, "many", lambda node: last.update(field=node.field), 8_000_000)
    assert tracemalloc.get_traced_memory()[1] < 8_000_000
    tracemalloc.stop()
    assert last == {"field": "many[30000]"}


def test_openmvg_is_refused_only_where_its_observations_do_not_fit(tmp_path: Path) -> None:
    path, count = tmp_path / "x.json", 100
    observations = [{"key": view, "value": {"id_feat": 0, "x": [1, 2.5]}} for view in range(9)]
    write_json(path, {"many": [{"value": {"X": [1, 2, 3], "observations": observations}}] * count})
    enough = _Structure(path, 10 * count * _OBSERVATION)
    load_json_in_pieces(path, "many", enough.add)
    assert enough.points.shape == (count, 3) and len(enough.tracks) == 9
    rows, where = enough.tracks[8]
    np.testing.assert_array_equal(rows, np.arange(count))
    np.testing.assert_array_equal(where, np.broadcast_to([1, 2.5], (count, 2)))
    with pytest.raises(InputError, match=r"x\.json: it has more observations than the memory"):
        load_json_in_pieces(path, "many", _Structure(path, 10 * count * _OBSERVATION - 1).add)


def test_limits_follow_the_memory(tmp_path: Path) -> None:
    _, source = opensfm(tmp_path / "source")
    with (tmp_path / "source" / "tracks.csv").open("a") as tracks:
        tracks.write("\n" * 200_000)
    with pytest.raises(InputError, match=r"tracks\.csv: too large"):
        read_opensfm(ImportSource(source.path, memory=1_000_000))
    cloud = tmp_path / "cloud.ply"
    head = ["ply", "format ascii 1.0", "element vertex 100", *(f"property float {axis}" for axis in "xyz")]
    cloud.write_text("\n".join([*head, "end_header", *["1 2 3"] * 100, ""]))
    assert len(read_point_cloud(cloud, 9_000)[0]) == 100
    with pytest.raises(InputError, match=r"100 points are too many for the memory that is free"):
        read_point_cloud(cloud, 8_999)
