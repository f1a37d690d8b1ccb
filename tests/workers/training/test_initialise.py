"""Where training starts: sizes from neighbours, the sky on its sphere in the colours of the panoramas."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree

from panolog.partition.bounds import Aabb
from panolog.partition.cells import Cell, Grid
from panolog.renderer.camera import Camera
from panolog.renderer.render import render
from panolog.scene.gaussians import SH_C0
from panolog.scene.images import View, exposed, exposure_affine, load_view
from panolog.scene.model import Scene
from panolog.scene.projection import fibonacci_sphere
from panolog.workers.training.config import SkyConfig, TrainConfig
from panolog.workers.training.initialise import (
    OUTSIDE,
    SCALE_MAX,
    camera_extent,
    evenly,
    first_model,
    near_distance,
    points_of,
    scene_gaussians,
    scene_length,
    sky_gaussians,
)
from panolog.workers.training.surfaces import NO_POINTS
from tests.on_device import view_on_device
from tests.workers.small import RADIUS, SKY_ELEVATION, WIDTH


def test_black_points_learn_their_colours(scene: Scene) -> None:
    """Many programs write no colours: at 0 they were clamped, and stayed black for ever."""
    black = replace(scene, colors=np.zeros_like(scene.colors))
    model = scene_gaussians(black)
    leaves = model.with_tensors({n: t.clone().requires_grad_() for n, t in model.tensors().items()})
    panorama = scene.panoramas[0]
    camera = Camera.of(panorama.rotation, panorama.translation, WIDTH, WIDTH // 2)
    rendered = render(leaves, camera, sh_degree=0, near=0.01)
    assert float(rendered.color.detach().max()) < 0.5 / 255
    (1 - rendered.color).square().sum().backward()  # type: ignore[no-untyped-call]
    assert leaves.sh0.grad is not None
    assert (leaves.sh0.grad[rendered.visible] < 0).float().mean() > 0.9


def test_points_without_colours_get_those_of_the_panoramas(scene: Scene) -> None:
    """Black ones learnt so slowly that a short run was 5 dB worse."""
    black = replace(scene, colors=np.zeros_like(scene.colors))
    chosen = np.arange(len(scene.points))

    def shown(row: int) -> View:
        picture = torch.full((WIDTH // 2, WIDTH, 3), 40 * row, dtype=torch.uint8)
        return View(row, picture, None, None, None)

    config = TrainConfig(sky=SkyConfig(count=20))
    views = scene.train
    model, _ = first_model(black, config, chosen, NO_POINTS, views, WIDTH * WIDTH // 2, shown)
    nearest = cKDTree(scene.centers[list(views)]).query(scene.points)[1]
    expected = 40 * np.array(views)[nearest]
    color = model.sh0[: len(chosen), 0].numpy() * SH_C0 + 0.5
    assert np.allclose(255 * color, np.maximum(expected, 0.25)[:, None], atol=1e-3)


def test_one_gaussian_for_each_point(scene: Scene) -> None:
    gaussians = scene_gaussians(scene)
    assert len(gaussians) == 200 and gaussians.sky == 0
    assert np.allclose(gaussians.means.numpy(), scene.points, atol=1e-6)
    assert torch.allclose(gaussians.opacities.sigmoid(), torch.tensor(0.1))
    assert torch.equal(gaussians.quats, torch.tensor([[1.0, 0, 0, 0]]).repeat(200, 1))
    color = gaussians.sh0[:, 0].numpy() * SH_C0 + 0.5
    assert np.allclose(255 * color, scene.colors, atol=1e-3)
    assert not gaussians.shN.any()


def test_near_is_measured_in_baselines_of_the_training_cameras(scene: Scene) -> None:
    line = [replace(p, translation=np.array([2.0 * i, 0, 0])) for i, p in enumerate(scene.panoramas)]
    spaced = replace(scene, panoramas=tuple(line), train=(0, 2, 4), test=(1, 3))
    assert near_distance(spaced, TrainConfig(near=0.1)) == pytest.approx(0.4)


def test_sizes_are_those_of_the_three_nearest_neighbours(scene: Scene) -> None:
    grid = 0.1 * np.stack(np.meshgrid(*[np.arange(4.0)] * 3), -1).reshape(-1, 3) + 5
    gaussians = scene_gaussians(replace(scene, points=grid, colors=np.zeros((64, 3), np.uint8)))
    assert torch.allclose(gaussians.scales.exp(), torch.tensor(0.1))


def test_lone_double_and_few_points_get_sensible_sizes(scene: Scene) -> None:
    points = np.array([[3.0, 0, 0], [3.0, 0, 0], [3.0, 0, 0], [3.0, 0, 0], [0, 900.0, 0]])
    sizes = scene_gaussians(replace(scene, points=points, colors=np.zeros((5, 3), np.uint8))).scales.exp()
    assert torch.isfinite(sizes).all() and (sizes > 0).all()
    assert sizes[4, 0] == pytest.approx(SCALE_MAX * 900, rel=1e-3)
    two = scene_gaussians(replace(scene, points=points[:2], colors=np.zeros((2, 3), np.uint8)))
    assert torch.isfinite(two.scales).all()


def test_sizes_do_not_depend_on_poses_that_are_held_out(scene: Scene) -> None:
    held_out = replace(scene.panoramas[4], translation=-scene.points[7])
    moved = replace(scene, panoramas=(*scene.panoramas[:4], held_out))
    assert torch.equal(scene_gaussians(moved).scales, scene_gaussians(scene).scales)


HALF = Cell(Aabb(np.full(3, -9.0), np.full(3, 9.0)), Grid((2, 1, 1)), 1)  # what lies at positive x


def test_a_district_begins_coarser_where_it_keeps_nothing(scene: Scene) -> None:
    random = np.random.default_rng(2)
    cloud = replace(scene, points=random.uniform(-9, 9, (4000, 3)), colors=np.zeros((4000, 3), np.uint8))
    everything, kept = set(range(4000)), cloud.points[:, 0] >= 0
    found = points_of(cloud, cloud.train, HALF, WIDTH)
    assert set(np.flatnonzero(kept)) <= set(found) < everything
    others = cloud.points[[row for row in found if not kept[row]]]
    distance = np.linalg.norm(others[:, None] - cloud.centers[list(cloud.train)], axis=2).min(axis=1)
    apart, _ = cKDTree(others).query(others, k=2)
    span = OUTSIDE * 2 * math.pi / WIDTH * distance
    assert 0.3 * np.median(span) < np.median(apart[:, 1]) < 2 * np.median(span)
    assert len(points_of(cloud, cloud.train, HALF, 8 * WIDTH)) > len(found)
    assert len(scene_gaussians(cloud, found)) == len(found)


def test_of_too_many_points_stage_one_starts_with_an_even_part() -> None:
    rows = np.arange(10, 20)
    assert evenly(rows, 4).tolist() == [10, 12, 15, 17]
    for most in (0, 10, 11):
        assert evenly(rows, most).tolist() == rows.tolist()


def test_extent_is_that_of_the_views_trained_on(scene: Scene) -> None:
    for views in (scene.train, (1, 2, 3)):
        centers = scene.centers[list(views)]
        radius = np.linalg.norm(centers - centers.mean(0), axis=1).max()
        assert camera_extent(scene, views) == pytest.approx(1.1 * radius)
    assert camera_extent(scene, (1,)) == pytest.approx(0.55 * scene_length(scene))


def test_sky_lies_on_its_sphere_without_holes(scene: Scene) -> None:
    sky, _ = sky_gaussians(
        scene, SkyConfig(), 500, scene.train, lambda row: load_view(scene.panoramas[row], row, WIDTH)
    )
    assert sky.sky == len(sky) == 500
    centroid = scene.centers[:4].mean(0)
    radius = 10 * np.linalg.norm(scene.points - centroid, axis=1).max()
    assert np.allclose(np.linalg.norm(sky.means.numpy() - centroid, axis=1), radius, rtol=1e-5)
    assert radius > 9 * RADIUS
    directions = fibonacci_sphere(500)
    cosines = directions @ directions.T - 2 * np.eye(500)
    nearest = np.arccos(cosines.max(1))
    assert nearest.min() > 0.5 * math.sqrt(4 * math.pi / 500)
    assert np.allclose(directions.mean(0), 0, atol=1e-3)


def test_what_training_begins_with_may_be_fainter_and_its_sky_blurred(scene: Scene) -> None:
    config = TrainConfig.model_validate({"initial_opacity": 0.01, "sky": {"count": 60, "size": 3.0}})
    usual, found = (
        first_model(
            scene, given, np.arange(len(scene.points)), NO_POINTS, scene.train, 10**6, lambda _: None
        )[0]
        for given in (TrainConfig(sky=SkyConfig(count=60)), config)
    )
    at = usual.scene
    assert torch.allclose(usual.opacities[at].sigmoid(), torch.tensor(0.1))
    assert torch.allclose(found.opacities[at].sigmoid(), torch.tensor(0.01))
    larger = found.scales.exp() / usual.scales.exp()
    assert torch.allclose(larger[at], torch.tensor(1.0)) and torch.allclose(larger[-60:], torch.tensor(3.0))


def test_the_exposures_of_panoramas_are_not_in_the_sky(scene: Scene) -> None:
    gains = torch.tensor([[-0.4], [0.3], [0.0], [0.2]], dtype=torch.float64).expand(4, 3)

    def sky(exposures: bool) -> torch.Tensor:
        def view(row: int) -> View:
            plain = load_view(scene.panoramas[row], row, WIDTH)
            dim = replace(plain, image=plain.image // 2 + 40)  # nothing clips
            if not exposures:
                return dim
            exposure = exposure_affine(torch.stack([gains[row], torch.zeros(3, dtype=torch.float64)]))
            return replace(dim, image=exposed(dim.image, exposure), exposure=exposure)

        return sky_gaussians(scene, SkyConfig(), 200, scene.train, view)[0].sh0 * SH_C0

    assert torch.allclose(sky(exposures=True), sky(exposures=False), atol=0.6 / 255)


def test_small_panoramas_may_have_a_small_sky() -> None:
    assert SkyConfig(count=1000).number(64) == 1000  # the paper: always so many
    config = SkyConfig(count=1000, pixels=8)
    assert [config.number(pixels) for pixels in (512, 7_999, 8_000, 10**6)] == [64, 999, 1000, 1000]
    assert SkyConfig(count=0, pixels=8).number(10**6) == 0


def test_sky_has_the_colour_of_the_sky_pixels(scene: Scene) -> None:
    row = scene.train[0]
    view = load_view(scene.panoramas[row], row, WIDTH)
    blue = torch.zeros_like(view.image)
    assert view.sky is not None
    blue[view.sky] = torch.tensor([0, 0, 255], dtype=torch.uint8)
    sky, seen = sky_gaussians(scene, SkyConfig(views=1), 400, (row,), lambda _: replace(view, image=blue))
    color = sky.sh0[:, 0] * SH_C0 + 0.5
    elevation = np.arcsin(
        np.clip((sky.means.numpy() / np.linalg.norm(sky.means.numpy(), axis=1)[:, None])[:, 1], -1, 1)
    )
    above = torch.from_numpy(elevation < SKY_ELEVATION - 0.1)
    below = torch.from_numpy(elevation > SKY_ELEVATION + 0.1)
    assert torch.allclose(color[above], torch.tensor([0.0, 0, 1]), atol=1e-3)
    assert torch.allclose(color[below & torch.from_numpy(elevation < 1.2)], torch.zeros(3), atol=1e-3)
    assert torch.allclose(
        color[torch.from_numpy(elevation > 1.5)], torch.tensor(0.5), atol=1e-5
    )  # all masked
    rim = SKY_ELEVATION + 3 * math.sqrt(4 * math.pi / 400)
    assert bool(seen[above].all()) and not bool(seen[torch.from_numpy(elevation > rim + 0.1)].any())
    assert bool(seen[torch.from_numpy(elevation < rim - 0.1)].all())
    plain, every = sky_gaussians(
        scene, SkyConfig(views=1), 400, (row,), lambda _: replace(view, image=blue, sky=None)
    )
    assert bool(every.all()) and torch.equal(plain.means, sky.means)


def test_views_on_a_device_colour_the_sky_alike(scene: Scene) -> None:
    config = SkyConfig()
    views = {row: load_view(scene.panoramas[row], row, WIDTH) for row in scene.train}
    here, seen = sky_gaussians(scene, config, 500, scene.train, views.__getitem__)
    there, too = sky_gaussians(scene, config, 500, scene.train, lambda row: view_on_device(views[row]))
    assert torch.equal(here.sh0, there.sh0) and torch.equal(seen, too)
