"""The models of the poles' benchmark: the same Gaussians, elsewhere."""

import math

import pytest
import torch
from torch import Tensor

from benchmarks.pairs import Counts
from benchmarks.poles import EVERY, Row, places, ratios
from panolog.renderer.reference import rotation_matrices
from panolog.scene.gaussians import Gaussians


def extent_along_the_ray(gaussians: Gaussians) -> Tensor:
    """(N,) variance along the direction to the camera: what a turn about the camera leaves."""
    directions = torch.nn.functional.normalize(gaussians.means, dim=1)
    axes = rotation_matrices(gaussians.quats).transpose(1, 2) @ directions[:, :, None]
    return ((axes[:, :, 0] * gaussians.scales.exp()) ** 2).sum(1)


@pytest.mark.parametrize("sizes", ["of the street", "of the gaps"])
def test_the_same_gaussians_lie_in_the_caps_and_at_the_horizon(sizes: str) -> None:
    found = {(what, place): model for what, size, place, model in places(2_000) if size == sizes}
    poles, horizon = found["5 % alone", "poles"], found["5 % alone", "horizon"]
    assert len(poles) == 2_000 // EVERY
    directions = torch.nn.functional.normalize(poles.means, dim=1)
    assert (directions[:, 2].abs() >= math.cos(math.radians(2.001))).all()
    assert int((directions[:, 2] > 0).sum()) == len(poles) // 2
    elevation = torch.asin(torch.nn.functional.normalize(horizon.means, dim=1)[:, 2])
    assert elevation.abs().max() <= math.radians(2.001)
    torch.testing.assert_close(horizon.means.norm(dim=1), poles.means.norm(dim=1))
    torch.testing.assert_close(
        extent_along_the_ray(horizon), extent_along_the_ray(poles), rtol=1e-3, atol=1e-9
    )
    for name in ("scales", "opacities", "sh0", "shN"):
        assert torch.equal(getattr(horizon, name), getattr(poles, name)), name
    assert len(found["all", "poles"]) == len(found["all", "horizon"]) == 2_000


def test_the_ratio_is_one_of_times_for_a_useful_pair() -> None:
    def row(place: str, useful: float, milliseconds: float) -> Row:
        return Row("all", "of the gaps", place, Counts(useful, 2 * useful, 10, 10), milliseconds, 100)

    found = ratios([row("horizon", 1000, 1.0), row("poles", 4000, 5.0)])
    assert found == {("all", "of the gaps"): pytest.approx(1.25)}
