"""Scenes far from their origin, such as in UTM or geocentric coordinates: moved on reading, in float64."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from panolog.orchestrator.cli.commands.render import ViewSpec, render_views
from panolog.orchestrator.cli.commands.scene import describe, lines
from panolog.scene.colmap import read_colmap, read_panoramas, write_colmap
from panolog.scene.errors import PlyError
from panolog.scene.image_files import decode_panorama
from panolog.scene.model import NO_OFFSET, Scene
from panolog.scene.ply import ply_offset, read_ply, write_ply
from panolog.scene.read import FAR, find_offset, read_scene
from panolog.workers.training.initialise import scene_gaussians
from tests.scenes import WIDTH, write_scene

UTM = (465_000.0, 5_250_000.0, 408.0)
ECEF = (4_278_990.0, 646_890.0, 4_670_550.0)
WORLDS = pytest.mark.parametrize("world", [UTM, ECEF], ids=["UTM", "ECEF"])


def model_of(root: Path) -> Path:
    return root / "sparse" / "0"


def moved(root: Path, world: tuple[float, float, float]) -> Path:
    """The scene with its COLMAP model in another world, as model_aligner writes it."""
    model = read_colmap(model_of(root))
    write_colmap(
        model_of(root),
        [(it.name, it.rotation, it.translation - it.rotation @ world) for it in model.images],
        width=WIDTH,
        height=WIDTH // 2,
        points=model.points + world,
        colors=model.colors,
        observations=[(it.points, it.pixels) for it in model.images],
    )
    return root


@pytest.fixture
def near(tmp_path: Path) -> Scene:
    return read_scene(write_scene(tmp_path / "near"))


@WORLDS
def test_a_far_world_is_moved_to_its_origin_in_full_precision(
    tmp_path: Path, near: Scene, world: tuple[float, float, float]
) -> None:
    far = read_scene(moved(write_scene(tmp_path / "far"), world))
    assert far.offset == world
    np.testing.assert_allclose(far.points, near.points, atol=1e-8)
    np.testing.assert_allclose(far.poses, near.poses, atol=1e-8)
    for ours, theirs in zip(far.panoramas, near.panoramas, strict=True):
        np.testing.assert_array_equal(ours.observed, theirs.observed)
    assert abs(scene_gaussians(far).means - scene_gaussians(near).means).max() < 2e-6
    original = read_panoramas(model_of(far.root))
    np.testing.assert_allclose(far.points + far.offset, original.points, atol=1e-8)


@pytest.mark.parametrize("times, expected", [(0.9, None), (1.1, (44.0, 0.0, 0.0))])
def test_the_criterion(times: float, expected: tuple[float, float, float] | None) -> None:
    centers = np.array([[4.0, 0, 0], [-4.0, 0, 0], [0, 4, 0], [0, -4, 0]])
    assert find_offset(centers + np.array([4 * FAR * times, 0, 0])) == expected


def test_scene_info_shows_the_offset(tmp_path: Path, near: Scene) -> None:
    far = describe(read_scene(moved(write_scene(tmp_path / "far"), UTM)))
    assert far["offset"] == list(UTM)
    assert any("(465000, 5250000, 408) is subtracted" in line for line in lines(far))
    assert describe(near)["offset"] == [0.0, 0.0, 0.0]
    assert not any("subtracted" in line for line in lines(describe(near)))


def test_a_ply_notes_the_offset_and_only_where_there_is_one(tmp_path: Path, near: Scene) -> None:
    model = scene_gaussians(near)
    write_ply(tmp_path / "plain.ply", model)
    write_ply(tmp_path / "moved.ply", model, offset=UTM)
    assert ply_offset(tmp_path / "plain.ply") == NO_OFFSET
    assert ply_offset(tmp_path / "moved.ply") == UTM
    assert b"offset" not in (tmp_path / "plain.ply").read_bytes()[:2000]
    assert torch.equal(read_ply(tmp_path / "moved.ply").means, model.means)


@pytest.mark.parametrize("comment", ["1 2", "a b c", "1 2 nan"])
def test_a_ply_with_a_wrong_offset_is_refused(tmp_path: Path, near: Scene, comment: str) -> None:
    path = tmp_path / "moved.ply"
    write_ply(path, scene_gaussians(near), offset=UTM)
    path.write_bytes(path.read_bytes().replace(b"465000.0 5250000.0 408.0", comment.encode()))
    with pytest.raises(PlyError, match="panolog offset"):
        ply_offset(path)


@WORLDS
def test_poses_of_a_file_are_in_the_coordinates_of_the_model(
    tmp_path: Path, near: Scene, world: tuple[float, float, float]
) -> None:
    model = replace(scene_gaussians(near), opacities=torch.full((len(near.points),), 3.0))
    write_ply(tmp_path / "near.ply", model)
    write_ply(tmp_path / "far.ply", model, offset=world)
    found = {}
    for name, place in (("near", NO_OFFSET), ("far", world)):
        poses = tmp_path / f"{name}.txt"
        center = near.panoramas[0].center + place
        poses.write_text("0 " + " ".join(map(repr, center.tolist())) + " 0 0 0 1\n")
        (path,) = render_views(
            tmp_path / f"{name}.ply", tmp_path / name, ViewSpec(WIDTH), poses=poses, frames=None, device="cpu"
        )
        found[name] = decode_panorama(path)
    assert found["near"].std() > 1
    assert np.abs(found["near"].astype(int) - found["far"].astype(int)).max() <= 1
