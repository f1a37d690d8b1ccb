"""The kernels' counts of pairs against the dense reference, and the scenes they are taken on."""

import pytest
import torch

from benchmarks.rasterizer.cases import Case, TrainingView, street, street_camera, street_case
from benchmarks.rasterizer.pairs import count
from panolog.renderer.camera import Camera
from panolog.renderer.render import render
from panolog.scene.gaussians import Gaussians
from tests.renderer import reference


def dense_pairs(gaussians: Gaussians, camera: Camera) -> int:
    projected = reference.project(gaussians, camera, 0, 0.0, torch.zeros(len(gaussians), 2))
    rows = projected.drawable.nonzero()[:, 0]
    rows = rows[projected.distance[rows].argsort(stable=True)]
    alpha = reference.pixel_alphas(reference.Projected(*(field[rows] for field in projected)), camera)
    left = torch.cumprod(torch.cat([torch.ones_like(alpha[:1]), 1 - alpha]), 0)[:-1]
    return int(((alpha > 0) & (left >= reference.TRANSMITTANCE_MIN)).sum())


@pytest.mark.parametrize("width", [64, 100])  # 100 × 50 ends within a tile
def test_useful_pairs_are_those_of_the_reference(width: int) -> None:
    case = street_case(300, width)
    expected = dense_pairs(case.gaussians, case.views[0].camera)
    assert expected > 5000
    counts = count(case)
    # rounding decides on which side of a cut a few pairs fall
    assert counts.useful == pytest.approx(expected, rel=1e-3)
    assert counts.useful <= counts.evaluated <= 256 * counts.entries
    assert 0 < counts.visible <= 300


def test_counts_are_means_over_the_images() -> None:
    case = street_case(300, 64)
    view = case.views[0]
    aside = Camera(view.camera.rotation, torch.tensor([0.0, 0.0, 2.0]), 64, 32)
    other = Case("other", case.gaussians, 0.0, (TrainingView(aside, view.target),))
    both = Case("both", case.gaussians, 0.0, (*case.views, *other.views))
    assert count(both).useful == (count(case).useful + count(other).useful) / 2


def test_a_street_is_sound_and_the_same_every_time() -> None:
    first, second = street(1000, sky=0.1), street(1000, sky=0.1)
    assert len(first) == 1000
    assert first.sky == 100
    for name, tensor in first.tensors().items():
        assert torch.isfinite(tensor).all(), name
        assert torch.equal(tensor, getattr(second, name)), name
    rendered = render(first, street_camera(128))
    assert not rendered.invalid.any()
    assert rendered.alpha.mean() > 0.8  # little shines through
