"""Exposures that Stage I learns: identifiable, exact where the model is, and the same after a resume."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from panolog.renderer.losses import photometric_loss
from panolog.scene.errors import RunError
from panolog.scene.images import exposure_affine, load_layers
from panolog.scene.model import Scene
from panolog.workers.capture.captured import Captured, joined
from panolog.workers.capture.config import ExposureConfig
from panolog.workers.capture.exposure import Exposures
from tests.workers.small import WIDTH

VIEWS = (3, 5, 8)
GAINS = torch.tensor([[0.4, 0.3, 0.5], [-0.2, -0.1, -0.3], [-0.2, -0.2, -0.2]], dtype=torch.float64)


def exposures() -> Exposures:
    return Exposures(torch.zeros(3, 2, 3, dtype=torch.float64), VIEWS)


def photograph(color: Tensor, exposure: Tensor) -> Tensor:
    affine = exposure_affine(exposure).double()
    return ((color * affine[0] + affine[1]) * 255).round().clamp(0, 255).to(torch.uint8)


def learnt(found: Exposures, truth: Tensor, visits: int, noise: float = 0.0) -> Tensor:
    random = torch.Generator().manual_seed(0)
    color = torch.rand(32, 64, 3, generator=random) * 0.6 + 0.1
    for _ in range(visits):
        for row, exposure in zip(VIEWS, truth, strict=True):
            rendered = (color + noise * torch.randn(color.shape, generator=random)).float()
            seen = photograph(color, exposure)
            sums = photometric_loss(rendered, seen, None, 0.2, None, found.of_view(row)).exposure
            assert sums is not None
            found.step(row, sums, None)
    return torch.from_numpy(found.learnt())


@pytest.mark.parametrize(("noise", "most"), [(0.0, 0.01), (0.05, 0.03)])
def test_gains_are_found_from_what_a_model_shows(noise: float, most: float) -> None:
    """Least squares of a photograph on a noisy rendering would find gains that are too small."""
    truth = torch.stack([GAINS, torch.zeros_like(GAINS)], 1)
    assert (learnt(exposures(), truth, 30, noise)[:, 0] - GAINS).abs().max() < most


def test_the_mean_gain_stays_where_it_was() -> None:
    truth = torch.stack([GAINS + 0.5, torch.zeros_like(GAINS)], 1)  # all brighter: the scene's business
    found = learnt(exposures(), truth, 5)
    assert found[:, 0].mean(0).abs().max() < 1e-12


def test_an_iteration_that_did_not_take_place_teaches_nothing() -> None:
    found = exposures()
    sums = torch.tensor([[10.0, 5.0, 3.0, 1.0, 0.5]] * 3, dtype=torch.float64)
    found.step(5, sums, torch.ones(1, dtype=torch.int32))
    assert not found.learnt().any()
    found.step(5, sums.fill_(float("nan")), torch.zeros(1, dtype=torch.int32))
    assert not found.learnt().any()
    found.step(5, sums.zero_(), None)  # a view without a pixel
    assert not found.learnt().any()


def test_auto_learns_where_something_was_measured(scene: Scene) -> None:
    assert Exposures.of(scene, scene.train, ExposureConfig(learn="auto"), "cpu") is None
    measured = np.zeros((len(scene.train), 2, 3))
    seen = Captured(rows=np.array(scene.train), exposure=measured).applied(scene)
    assert Exposures.of(seen, seen.train, ExposureConfig(learn="auto"), "cpu") is not None
    assert Exposures.of(seen, seen.train, ExposureConfig(learn=False), "cpu") is None
    assert Exposures.of(scene, scene.train, ExposureConfig(learn=True), "cpu") is not None


def test_a_view_has_its_exposure(scene: Scene) -> None:
    exposure = np.stack([np.log([1.5, 1.0, 0.5]), [0.0, 0.1, 0.0]])
    view = load_layers(replace(scene.panoramas[0], exposure=exposure), 0, WIDTH)
    factor = np.array([1.5, 1.0, 0.5]) ** (1 / 2.4)
    assert view.exposure is not None
    np.testing.assert_allclose(view.exposure[0], factor, rtol=1e-6)
    np.testing.assert_allclose(view.exposure[1], 0.055 * (factor - 1) + [0, 0.1, 0], atol=1e-7)


def test_what_is_captured_survives_its_file(tmp_path: Path, scene: Scene) -> None:
    random = np.random.default_rng(0)
    turned = np.linalg.qr(random.normal(size=(2, 3, 3)))[0]
    poses = np.concatenate([turned, random.normal(size=(2, 3, 1))], axis=2)
    movers = random.random((2, 4, 8)) > 0.5
    whole = Captured(
        rows=np.array([0, 2]), exposure=random.normal(size=(2, 2, 3)), poses=poses, movers=movers
    )
    whole.save(tmp_path / "captured.npz")
    first = (tmp_path / "captured.npz").read_bytes()
    found = Captured.load(tmp_path / "captured.npz").applied(scene)
    assert whole.exposure is not None
    np.testing.assert_array_equal(found.panoramas[2].exposure, whole.exposure[1])
    np.testing.assert_array_equal(found.panoramas[0].rotation, poses[0, :, :3])
    np.testing.assert_array_equal(found.panoramas[2].translation, poses[1, :, 3])
    np.testing.assert_array_equal(found.panoramas[2].movers, movers[1])
    assert found.panoramas[1] is scene.panoramas[1]
    whole.save(tmp_path / "captured.npz")
    assert (tmp_path / "captured.npz").read_bytes() == first


def test_districts_are_joined_to_one() -> None:
    """Of a panorama in both the mean, and what either says of movers and bounds."""
    pose, seen = np.eye(3, 4), np.zeros((2, 4, 8), bool)
    seen[1, 2, 5] = True
    one, two = (
        Captured(
            rows=np.array(rows),
            exposure=np.full((2, 2, 3), gain),
            poses=np.stack([pose + shift * np.eye(3, 4, 3), pose]),
            movers=movers,
            at_bound=bound,
        )
        for rows, gain, shift, movers, bound in (
            ([0, 1], 1.0, 0.0, seen, np.array([False, True])),
            ([1, 4], 2.0, 1.0, ~seen[::-1], np.zeros(2, bool)),
        )
    )
    both = joined([one, two])
    assert both.rows.tolist() == [0, 1, 4]
    assert both.exposure is not None and both.exposure[:, 0, 0].tolist() == [1.0, 1.5, 2.0]
    assert both.poses is not None and both.poses[1] == pytest.approx(pose + 0.5 * np.eye(3, 4, 3))
    assert both.movers is not None and both.movers.dtype == np.bool_
    assert both.movers.sum(axis=(1, 2)).tolist() == [0, 32, 32] and both.movers[1, 2, 5]
    assert both.at_bound is not None and both.at_bound.tolist() == [False, True, False]
    assert joined([one, replace(two, movers=None)]).movers is None


def test_a_damaged_file_is_one_line(tmp_path: Path) -> None:
    (tmp_path / "captured.npz").write_bytes(b"PK nothing")
    with pytest.raises(RunError, match=r"captured\.npz: is damaged"):
        Captured.load(tmp_path / "captured.npz")
