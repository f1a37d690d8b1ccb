"""Points of the surfaces that depth maps agree on, which Stage I begins with."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from panolog.scene.images import load_view
from panolog.scene.model import Scene
from panolog.workers.sound_views import SoundViews
from panolog.workers.training.surfaces import Points, Surfaces
from panolog.workers.training.trainer import TrainSpec
from tests.on_device import view_on_device
from tests.workers.small import RADIUS, SKY_ELEVATION, WIDTH, distance_along, rays_of, small_scene
from tests.workers.trainings import RELOCATED, begun, coarse_of, settings

Target = tuple[Tensor, Tensor]


def target_of(scene: Scene, row: int) -> Target:
    """What an exact map of the hollow sphere shows, without its sky."""
    rays = rays_of(WIDTH)
    inverse = 1 / distance_along(rays, scene.panoramas[row].center)
    return torch.from_numpy(inverse).float(), torch.from_numpy(np.arcsin(rays[..., 1]) >= SKY_ELEVATION)


def points_of(
    scene: Scene, count: int, change: Callable[[int, Target], Target | None] = lambda _, target: target
) -> Points:
    """At most `count` points. Args: change, what becomes of the exact map of a row."""
    surfaces = Surfaces(scene)
    for row in scene.train:
        view = load_view(scene.panoramas[row], row, WIDTH)
        surfaces.add(view, change(row, target_of(scene, row)))
    return surfaces.points(scene.points, scene.centers[list(scene.train)], count)


def test_points_are_on_the_surface_in_its_colours_and_where_others_are_missing(scene: Scene) -> None:
    half = scene.points[scene.points[:, 0] > 0]  # where the other half is empty
    found = points_of(replace(scene, points=half), 400)
    assert 300 < len(found) <= 400
    assert np.allclose(np.linalg.norm(found.points, axis=1), RADIUS, rtol=0.01)
    assert (found.points[:, 0] < 0).mean() > 0.7
    apart, _ = cKDTree(found.points).query(found.points, k=2)
    assert np.median(apart[:, 1]) > 0.5 * np.sqrt(4 * np.pi * RADIUS**2 / 800)  # evenly, not in one place
    sky = found.points[:, 1] / RADIUS < np.sin(SKY_ELEVATION) - 0.05
    assert not sky.any()
    view = load_view(scene.panoramas[0], 0, WIDTH)
    u = (np.arctan2(*(found.points - scene.centers[0]).T[[0, 2]]) / (2 * np.pi) + 0.5) * WIDTH
    v = (
        (np.arcsin((found.points - scene.centers[0])[:, 1] / distance_of(found.points, scene)) / np.pi + 0.5)
        * WIDTH
        / 2
    )
    shown = view.image.numpy()[v.astype(int), u.astype(int)].astype(float)
    assert np.median(abs(found.colors - shown)) < 8


def distance_of(points: np.ndarray, scene: Scene) -> np.ndarray:
    distance: np.ndarray = np.linalg.norm(points - scene.centers[0], axis=1)
    return distance


@pytest.mark.parametrize("factor", [0.8, 1.25])
def test_what_one_map_alone_shows_is_no_surface(scene: Scene, factor: float) -> None:
    """Too near as well as too far."""
    found = points_of(scene, 300, lambda row, target: (target[0] / factor, target[1]) if row == 1 else target)
    assert len(found) > 100
    assert np.allclose(np.linalg.norm(found.points, axis=1), RADIUS, rtol=0.01)
    assert len(points_of(scene, 300, lambda row, target: target if row == 1 else None)) == 0


def test_without_maps_or_need_there_are_none(scene: Scene) -> None:
    assert len(points_of(scene, 300, lambda *_: None)) == len(points_of(scene, 0)) == 0


def test_the_width_and_the_device_of_the_maps_hardly_matter(scene: Scene) -> None:
    there, here = Surfaces(scene), Surfaces(scene)
    for row in scene.train:
        view = load_view(scene.panoramas[row], row, WIDTH)
        on_device = view_on_device(view)
        here.add(view, target_of(scene, row))
        there.add(on_device, target_of(scene, row))
    centers = scene.centers[list(scene.train)]
    found = [surfaces.points(scene.points, centers, 200) for surfaces in (here, there)]
    assert np.array_equal(found[0].points, found[1].points) and np.array_equal(
        found[0].colors, found[1].colors
    )


def first_of(spec: TrainSpec) -> tuple[int, int]:
    """Scene Gaussians before the first iteration, and those of the law of growth."""
    with begun(spec) as trainer:
        return trainer.state.gaussians.scene.stop, trainer.start


def test_without_depth_images_nothing_is_decoded_for_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene = small_scene(tmp_path, layers=False)
    monkeypatch.setattr(SoundViews, "get", lambda *_: pytest.fail("decodes"))
    config = settings(densify=RELOCATED, depth={"points": 0.8}, sky={"count": 0})
    assert first_of(coarse_of(scene, config)) == (200, 200)


def test_stage_one_begins_with_part_of_its_budget(scene: Scene) -> None:
    config = settings(densify=RELOCATED | {"growth": 2.0}, depth={"points": 0.8})
    spec = coarse_of(scene, config)
    budget = 200 + int(200 * 2.0 * (0.85 + 0.5 * np.log(WIDTH**2 / 2 / 200)))
    count, start = first_of(spec)
    assert start == 200 and 0.75 * budget < count <= 0.8 * budget
    assert first_of(replace(spec, config=settings(densify=RELOCATED | {"growth": 2.0}))) == (200, 200)
    assert first_of(replace(spec, config=settings(depth={"points": 0.8, "w0": 0.0}))) == (200, 200)
