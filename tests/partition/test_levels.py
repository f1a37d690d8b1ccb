"""Levels of detail: each own Gaussian is in a cut once, itself or merged, and what is merged looks small."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from panolog.partition.levels import Levels, Light, _seen_larger, expected_cut, make_levels, merge_moments
from panolog.renderer.camera import Camera
from panolog.renderer.render import render
from panolog.scene.gaussians import Gaussians

SIDE = 0.1  # of the smallest cubes
WIDTH = 256
ANGLE = 1.5 * 2 * math.pi / WIDTH
LOW_PASS = 1.2 * math.sqrt(0.3) / 1.5  # in sides of a cube that spans 1.5 pixels


def cloud(count: int, seed: int = 0, size: float = 0.04) -> Gaussians:
    """Gaussians on the walls of a room of 4 units, some of them far larger than all others."""
    random = np.random.default_rng(seed)
    means = random.uniform(-2, 2, (count, 3))
    means[np.arange(count), random.integers(0, 3, count)] = 2.0 * random.choice([-1, 1], count)
    scales = np.log(size * random.uniform(0.5, 1.5, (count, 3)))
    scales[:: max(1, count // 5)] += 2.5
    colors = np.sin(2 * means[:, None] + np.array([0.0, 1.0, 2.0]))
    arrays = {
        "means": means,
        "quats": random.normal(size=(count, 4)),
        "scales": scales,
        "opacities": random.normal(1.0, 1.0, count),
        "sh0": colors,
        "shN": np.zeros((count, 15, 3)),
    }
    tensors = {name: torch.from_numpy(array.astype(np.float32)) for name, array in arrays.items()}
    return Gaussians(**tensors, sky=0, exact=False)


def leaves(levels: Levels, row: int) -> tuple[int, int]:
    """The level of a row, and the smallest cube that its own cube begins with, and the one after its last."""
    number = max(n for n, level in enumerate(levels.levels) if level.starts[0] <= row)
    level = levels.levels[number]
    first = int(np.searchsorted(level.starts, row, side="right")) - 1
    last = first + 1
    for below in levels.levels[number:0:-1]:
        first, last = int(below.children[first]), int(below.children[last])
    return first, last


def test_the_lowest_level_has_the_own_gaussians_and_no_other() -> None:
    scene = cloud(2_000)
    levels = make_levels(scene, SIDE)
    assert levels.own == len(scene)
    own = levels.rows(np.arange(levels.own))
    for name, tensor in scene.tensors().items():
        found, expected = (it.reshape(len(scene), -1).tolist() for it in (own.tensors()[name], tensor))
        assert sorted(found) == sorted(expected)


@pytest.mark.parametrize("distance", [0.0, 5.0, 40.0, 1e6])
def test_a_cut_has_each_cube_once_and_none_that_looks_large(distance: float) -> None:
    levels = make_levels(cloud(2_000), SIDE)
    centers = np.array([[distance, 0.0, 0.0], [distance, 0.5, 0.1]])
    rows = levels.cut(centers, ANGLE)
    assert (np.diff(rows) > 0).all()
    spans = {leaves(levels, int(row)) for row in rows}
    covered = np.zeros(len(levels.levels[0].places), np.int64)
    for first, last in spans:
        covered[first:last] += 1
    assert (covered == 1).all()
    for row in rows[rows >= levels.own]:
        level = max((it for it in levels.levels if it.starts[0] <= row), key=lambda it: it.starts[0])
        (corner,) = level.corners(np.searchsorted(level.starts, [row], side="right") - 1)
        nearest = np.linalg.norm(np.clip(centers, corner, corner + level.side) - centers, axis=1).min()
        assert level.side <= ANGLE * nearest


def test_a_cut_is_no_finer_than_the_cameras_require() -> None:
    random = np.random.default_rng(3)
    corners, centers = random.uniform(-40, 40, (20_000, 3)), random.uniform(-40, 40, (7, 3))
    side = 0.5
    lower = corners[:, None]
    apart = np.maximum(np.maximum(lower - centers, centers - lower - side), 0)
    distance = np.linalg.norm(apart, axis=2).min(axis=1)
    for angle in (0.01, ANGLE, 0.2):
        seen = _seen_larger(corners, side, cKDTree(centers), angle)
        assert np.array_equal(seen, distance * angle < side)
        assert seen.any()


@pytest.mark.parametrize("exact", [False, True])
@pytest.mark.parametrize("distance", [10.0, 30.0])
def test_a_cut_looks_as_what_it_stands_for(distance: float, exact: bool) -> None:
    scene = replace(cloud(20_000), exact=exact)
    levels, center = make_levels(scene, SIDE, LOW_PASS), np.array([[0.0, 0.0, -distance]])
    rows = levels.cut(center, ANGLE)
    assert len(rows) < len(scene) / 10
    at = Camera.of(np.eye(3), -center[0], WIDTH, WIDTH // 2)
    full, few = (render(it, at, near=0.01) for it in (scene, levels.rows(rows)))
    seen = full.alpha > 0.02
    assert (full.color - few.color)[seen].abs().mean() < (
        0.02 if distance < 20 else 0.08
    )  # 5 pixels wide at 30
    assert float(few.alpha.sum() / full.alpha.sum()) == pytest.approx(1, abs=0.05)


def test_two_merge_into_their_mean_and_covariance() -> None:
    apart, scales = np.array([0.3, 0.0, 0.0]), np.array([0.2, 0.1, 0.05])
    turn = Rotation.from_rotvec([0.4, -0.2, 0.9])
    pair = Gaussians(
        means=torch.tensor(np.array([apart, -apart]), dtype=torch.float32),
        quats=torch.tensor(np.tile(3 * turn.as_quat(scalar_first=True), (2, 1)), dtype=torch.float32),
        scales=torch.tensor(np.log(np.tile(scales, (2, 1))), dtype=torch.float32),
        opacities=torch.zeros(2),
        sh0=torch.tensor([[[1.0, 0.0, 0.0]], [[0.0, 0.0, 1.0]]]),
        shN=torch.zeros(2, 15, 3),
    )
    one = merge_moments(pair, np.array([0]), Light.of(pair))
    axes = turn.as_matrix() * scales
    expected = axes @ axes.T + np.outer(apart, apart)
    found = Rotation.from_quat(one.quats[0].numpy(), scalar_first=True).as_matrix()
    found = found * np.exp(one.scales[0].numpy())
    assert np.allclose(found @ found.T, expected, atol=1e-6)
    assert torch.allclose(one.means, torch.zeros(1, 3), atol=1e-7)
    assert torch.allclose(one.sh0, torch.tensor([[[0.5, 0.0, 0.5]]]))

    covered = float(Light.of(pair).stopped.sum() / Light.of(one).stopped[0] * one.opacities.sigmoid()[0])
    assert one.opacities.sigmoid().item() == pytest.approx(2 - 2 * math.exp(-covered / 2), abs=1e-5)


@pytest.mark.parametrize("low_pass", [0.0, 0.3])
def test_what_covers_more_than_one_can_makes_it_larger(low_pass: float) -> None:
    random = np.random.default_rng(2)
    many = cloud(5_000)
    many.means[:] = torch.from_numpy(random.normal(0, [1.0, 1.0, 0.01], (5_000, 3)).astype(np.float32))
    one = merge_moments(many, np.array([0]), Light.of(many), low_pass)
    assert one.opacities.sigmoid().item() > 0.99
    size = one.scales.exp().sort().values[0, 1:]
    filtered = torch.sqrt((size**2 + low_pass**2) / (1 + low_pass**2))
    assert filtered.min() > 1.35 and filtered.max() < 1.5


def test_the_opaque_count_for_more() -> None:
    pair = cloud(2, size=0.1)
    pair.scales[:] = math.log(0.1)
    pair.opacities[:] = torch.tensor([4.0, -4.0])
    one = merge_moments(pair, np.array([0]), Light.of(pair))
    share = pair.opacities.sigmoid() / pair.opacities.sigmoid().sum()
    assert torch.allclose(one.means[0], share @ pair.means, atol=1e-5)


@pytest.mark.parametrize("each", [1, 4])
def test_the_size_of_a_cut_is_expected_from_points_alone(each: int) -> None:
    """Of Gaussians as large as trained ones, which overlap: all near by, and where cubes are large, these."""
    scene = cloud(12_000, size=0.25)
    points, levels = scene.means.numpy().astype(np.float64)[::each], make_levels(scene, ANGLE)
    sizes = []
    for distance in (2.0, 10.0, 60.0):
        centers = np.array([[0.0, 0.0, 2 + distance]])
        expected = expected_cut(points, len(scene) / len(points), centers, ANGLE, least=1.0)
        sizes.append((expected, len(levels.cut(centers, ANGLE))))
    assert sizes[0] == pytest.approx((len(scene), len(scene)), rel=0.1)
    assert sizes[0][0] >= sizes[1][0] > sizes[2][0]
    assert sizes[2][1] / 3 < sizes[2][0] < 3 * sizes[2][1] < len(scene) / 10


def test_few_points_are_expected_to_stay() -> None:
    centers = np.zeros((1, 3))
    assert expected_cut(np.zeros((0, 3)), 3.0, centers, ANGLE, least=1.0) == 0
    assert expected_cut(np.ones((2, 3)), 3.0, centers, ANGLE, least=1.0) == 6


def test_the_order_of_the_gaussians_changes_no_level() -> None:
    scene = cloud(500)
    other = scene.with_tensors({name: tensor.flip(0) for name, tensor in scene.tensors().items()})
    first, second = make_levels(scene, SIDE), make_levels(other, SIDE)
    assert len(first.levels) == len(second.levels)
    for a, b in zip(first.levels, second.levels, strict=True):
        assert np.array_equal(a.starts, b.starts) and np.array_equal(a.children, b.children)
        assert np.array_equal(a.places, b.places)


@pytest.mark.parametrize("count", [0, 1, 2])
def test_a_block_may_have_few_or_no_gaussians(count: int) -> None:
    levels = make_levels(cloud(count), SIDE)
    assert levels.own == count
    for distance in (0.0, 1e6):
        rows = levels.cut(np.array([[distance, 0.0, 0.0]]), ANGLE)
        assert (len(rows) > 0) == (count > 0)


def test_what_is_beyond_all_cubes_is_never_merged() -> None:
    scene = cloud(100)
    scene.means[::10] = 1e8 * torch.randn(10, 3, generator=torch.Generator().manual_seed(1))
    levels = make_levels(scene, SIDE)
    rows = levels.cut(np.array([[0.0, 0.0, 1e12]]), ANGLE)
    far = levels.rows(rows).means.abs().amax(1) > 1e6
    assert far.sum() == 10
    assert np.isfinite(levels.values["means"]).all()
