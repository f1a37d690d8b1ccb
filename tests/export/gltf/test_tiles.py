"""3D Tiles: the structure that OGC 22-025r4 prescribes, content within its bounds, and levels of detail."""

import json
import re
from collections.abc import Iterator
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from panolog.export.earth import enu_to_ecef
from panolog.export.gltf import tiles
from panolog.export.gltf.tiles import write_tiles
from panolog.export.splats import InMemory, Splats
from panolog.export.spz import decode
from panolog.scene.errors import FormatError
from tests.export.gaussians import matched, scattered
from tests.export.gltf.reading import read_glb

SPZ = "KHR_gaussian_splatting_compression_spz_2"
TILE = {"boundingVolume", "geometricError", "refine", "transform", "content", "children"}


def tileset(folder: Path) -> dict[str, Any]:
    """The tileset, which has what the specification's schemas require, and nothing else.

    CesiumGS's own validator is not on npm.
    """
    found: dict[str, Any] = json.loads((folder / "tileset.json").read_text())
    assert set(found) - {"extensionsUsed", "extensions"} == {"asset", "geometricError", "root"}
    assert found["asset"]["version"] == "1.1" and found["root"]["refine"] in ("ADD", "REPLACE")
    for tile in (found["root"], *(child for _, child in below(found["root"]))):
        assert {"boundingVolume", "geometricError"} <= set(tile) <= TILE
        assert set(tile["boundingVolume"]) == {"box"} and len(tile["boundingVolume"]["box"]) == 12
        assert tile["geometricError"] >= 0 and len(tile.get("transform", range(16))) == 16
        assert re.fullmatch("[0-9-]+[.]glb", tile.get("content", {"uri": "0.glb"})["uri"])
        assert tile.get("children", True)
    return found


def below(tile: dict[str, Any]) -> Iterator[tuple[dict[str, Any], dict[str, Any]]]:
    """All pairs of a tile and a child."""
    for child in tile.get("children", []):
        yield tile, child
        yield from below(child)


def content(folder: Path, tile: dict[str, Any]) -> Splats:
    """The Gaussians of a tile, y up, where the model has them."""
    glb = read_glb(folder / tile["content"]["uri"])
    local = decode(BytesIO(glb.view(0)), "glb")
    return Splats(**local.columns() | {"means": (local.means + glb.matrix[:3, 3]).astype(np.float32)})


def corners(tile: dict[str, Any]) -> tuple[Any, Any]:
    """Lower and upper corner of a tile's box, whose axes are those of the tileset."""
    box = np.array(tile["boundingVolume"]["box"]).reshape(4, 3)
    np.testing.assert_array_equal(box[1:], np.diag(np.diag(box[1:])))
    return box[0] - np.diag(box[1:]), box[0] + np.diag(box[1:])


def street(count: int = 12_000) -> Splats:
    """A long model, which is cut."""
    splats = scattered(count, 1, extent=1)
    return Splats(**splats.columns() | {"means": splats.means * np.array([100, 5, 20], np.float32)})


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("tiles") / "town"
    write_tiles(folder, InMemory(street()), to_ecef=enu_to_ecef(48, 11, 500), side=60, levels=3)
    return folder


def test_structure(written: Path) -> None:
    found = tileset(written)
    gltf = found["extensions"]["3DTILES_content_gltf"]
    assert gltf["extensionsRequired"] == gltf["extensionsUsed"] == ["KHR_gaussian_splatting", SPZ]
    assert found["geometricError"] >= found["root"]["geometricError"] > 100
    pairs = list(below(found["root"]))
    assert all("transform" not in child for _, child in pairs)
    for tile, child in pairs:
        assert tile["geometricError"] >= child["geometricError"]
        (lower, upper), (inner_lower, inner_upper) = corners(tile), corners(child)
        assert (lower <= inner_lower + 1e-9).all() and (inner_upper <= upper + 1e-9).all()
        assert "content" in child or "content" not in tile
    ends = [child for _, child in pairs if "children" not in child]
    assert len(ends) > 2 and all(tile["geometricError"] == 0 for tile in ends)
    named = {child["content"]["uri"] for _, child in pairs if "content" in child}
    assert named | {"tileset.json"} == {file.name for file in written.iterdir()}


def test_leaves_have_all_gaussians_and_levels_fewer(written: Path) -> None:
    pairs = list(below(tileset(written)["root"]))
    whole = [content(written, child) for _, child in pairs if "children" not in child]
    means = np.concatenate([part.means for part in whole])
    was = matched(street(), means)
    assert np.abs(means - was.means).max() < 2.0**-12
    chains = [(tile, child) for tile, child in pairs if "content" in tile]
    assert len(chains) == 2 * len(whole)
    for tile, child in chains:
        assert len(content(written, tile)) < 0.9 * len(content(written, child))
        side = tile["geometricError"] / 8  # of the cubes in which Gaussians are merged
        assert 0 < side < 20


def test_boxes_hold_what_gaussians_cover(written: Path) -> None:
    """Ends of axes of 3 standard deviations lie in the box, after the turn from y up to z up."""
    for _, tile in below(tileset(written)["root"]):
        if "content" not in tile:
            continue
        splats, (lower, upper) = content(written, tile), corners(tile)
        axes = Rotation.from_quat(splats.quats, scalar_first=True).as_matrix()
        for axis in range(3):
            reach = 2.9 * axes[:, :, axis] * np.exp(splats.scales[:, axis, None])
            for end in (splats.means - reach, splats.means + reach):
                z_up = np.stack([end[:, 0], -end[:, 2], end[:, 1]], axis=1)
                assert (z_up > lower - 1e-3).all() and (z_up < upper + 1e-3).all()


def test_the_transform_leads_to_the_earth(written: Path, tmp_path: Path) -> None:
    matrix = np.array(tileset(written)["root"]["transform"]).reshape(4, 4).T
    np.testing.assert_array_equal(matrix, enu_to_ecef(48, 11, 500))
    assert np.linalg.norm(matrix[:3, 3]) == pytest.approx(6.367e6, rel=1e-3)
    write_tiles(tmp_path / "nowhere", InMemory(scattered(100)), to_ecef=None)
    found = tileset(tmp_path / "nowhere")
    assert "transform" not in found["root"]
    assert found["root"]["content"]["uri"] == "0-0.glb"  # a single tile
    assert found["geometricError"] > 100  # else it would never be shown


def test_the_folder_appears_whole_or_not_at_all(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "empty").mkdir()
    write_tiles(tmp_path / "empty", InMemory(scattered(100)), to_ecef=None)
    with pytest.raises(FormatError, match="exists already"):
        write_tiles(tmp_path / "empty", InMemory(scattered(100)), to_ecef=None)

    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(tiles, "encode_glb", full)
    with pytest.raises(OSError, match="No space"):
        write_tiles(tmp_path / "town", InMemory(scattered(100)), to_ecef=None)
    assert [file.name for file in tmp_path.iterdir()] == ["empty"]
