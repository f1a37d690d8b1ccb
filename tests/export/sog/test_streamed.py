"""Streamed SOG: leaves and levels are where its index says, also for the peers that stream it."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from panolog.export.detail import Detail
from panolog.export.sog.read import read_sog
from panolog.export.sog.streamed import bounds, write_streamed
from panolog.export.splats import InMemory
from panolog.scene.errors import FormatError
from tests.export.sog.models import source, splats

LEVELS = 3


def leaves(tree: dict[str, Any]) -> list[dict[str, Any]]:
    """All leaves of a tree, in order; boxes contain those of their children."""
    for child in tree.get("children", []):
        assert (np.array(tree["bound"]["min"]) <= child["bound"]["min"]).all()
        assert (np.array(tree["bound"]["max"]) >= child["bound"]["max"]).all()
    return [leaf for child in tree["children"] for leaf in leaves(child)] if "children" in tree else [tree]


@pytest.fixture(scope="module")
def streamed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A model of several leaves, with a sky."""
    folder = tmp_path_factory.mktemp("streamed") / "web"
    write_streamed(folder, source(5000, 1), source(500, 0, seed=9), side=8, most=800, levels=LEVELS)
    return folder


def test_each_leaf_is_where_the_index_says(streamed: Path, tmp_path: Path) -> None:
    meta = json.loads((streamed / "lod-meta.json").read_text())
    detail = Detail(source(5000, 1), tmp_path, side=8, most=800, levels=LEVELS)
    files = [read_sog(streamed / name) for name in meta["filenames"]]
    found = leaves(meta["tree"])
    assert len(found) > 5
    for leaf, wanted in zip(found, detail.leaves(), strict=True):
        for level, place in leaf["lods"].items():
            part = files[place["file"]].select(slice(place["offset"], place["offset"] + place["count"]))
            own = wanted[int(level)]
            assert len(part) == len(own)
            np.testing.assert_allclose(part.means, own.means, rtol=2e-4, atol=2e-3)
            lower, upper = bounds(own)
            assert (np.array(leaf["bound"]["min"]) <= lower + 1e-4).all()
            assert (np.array(leaf["bound"]["max"]) >= upper - 1e-4).all()
    counts = [
        sum(leaf["lods"].get(str(level), {"count": 0})["count"] for leaf in found) for level in range(LEVELS)
    ]
    assert meta["counts"] == counts and meta["count"] == sum(counts) and meta["lodLevels"] == LEVELS
    assert counts[0] == 5000 > counts[1] > counts[2]
    assert sum(map(len, files)) == sum(counts) and max(map(len, files)) <= 800
    kinds = {path.relative_to(streamed).parts[0] for path in streamed.rglob("*")}
    assert kinds == {"lod-meta.json", "env", *(name.split("/")[0] for name in meta["filenames"])}
    assert len(read_sog(streamed / meta["environment"])) == 500
    with pytest.raises(FormatError, match="a SOG that streams has many files"):
        read_sog(streamed)


def test_it_replaces_its_own_only(tmp_path: Path) -> None:
    folder = tmp_path / "web"
    write_streamed(folder, source(300, 1), source(20, 0), most=100, levels=2)
    write_streamed(folder, source(10, 0))
    assert sorted(path.name for path in folder.iterdir()) == ["0_0", "lod-meta.json"]
    assert json.loads((folder / "lod-meta.json").read_text())["counts"] == [10]
    index = (folder / "lod-meta.json").read_text()
    (folder / "lod-meta.json").write_text(index.replace('"panolog"', '"other"'))
    with pytest.raises(FormatError, match="choose another folder"):
        write_streamed(folder, source(10))
    (folder / "lod-meta.json").write_text(index)
    (folder / "0_0" / "photo.jpg").write_text("mine")
    with pytest.raises(FormatError, match=r"photo\.jpg: not written as a SOG"):
        write_streamed(folder, source(10))
    assert [path.name for path in tmp_path.iterdir()] == ["web"] and (folder / "0_0/photo.jpg").exists()


def test_what_fails_leaves_nothing(tmp_path: Path) -> None:
    class Failing(InMemory):
        calls = 0

        def pieces(self):  # type: ignore[no-untyped-def]
            Failing.calls += 1
            if Failing.calls > 1:
                raise OSError("the disk is gone")
            return super().pieces()

    write_streamed(tmp_path / "web", source(10))
    with pytest.raises(OSError, match="the disk is gone"):
        write_streamed(tmp_path / "web", Failing(splats(2000)))
    assert [path.name for path in tmp_path.iterdir()] == ["web"] and (tmp_path / "web/0_0/meta.json").exists()
