"""The count of useful pairs against the dense reference, and the scenes it is taken on."""

import pytest
import torch

from benchmarks.pairs import useful_pairs
from benchmarks.street import middle, street
from panolog.renderer import reference
from panolog.renderer.camera import Camera
from panolog.renderer.render import render
from panolog.scene.gaussians import Gaussians


def dense_pairs(gaussians: Gaussians, camera: Camera) -> int:
    projected = reference.project(gaussians, camera, 0, 0.0, torch.zeros(len(gaussians), 2))
    rows = projected.drawable.nonzero()[:, 0]
    rows = rows[projected.distance[rows].argsort(stable=True)]
    alpha = reference.pixel_alphas(reference.Projected(*(field[rows] for field in projected)), camera)
    left = torch.cumprod(torch.cat([torch.ones_like(alpha[:1]), 1 - alpha]), 0)[:-1]
    return int(((alpha > 0) & (left >= reference.TRANSMITTANCE_MIN)).sum())


def test_all_rows_give_the_exact_count(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("benchmarks.pairs._CHUNK", 64 * 20)  # transmittance is carried from chunk to chunk
    gaussians, camera = street(300), middle(64)
    expected = dense_pairs(gaussians, camera)
    assert expected > 5000
    # rounding decides on which side of a cut a few pairs fall
    assert useful_pairs(gaussians, camera, rows=32) == pytest.approx(expected, rel=1e-3)


def test_some_rows_give_nearly_the_count() -> None:
    gaussians, camera = street(2000), middle(128)
    exact = useful_pairs(gaussians, camera, rows=64)
    assert useful_pairs(gaussians, camera, rows=16) == pytest.approx(exact, rel=0.05)


def test_a_street_is_sound_and_the_same_every_time() -> None:
    first, second = street(1000, sky=0.1), street(1000, sky=0.1)
    assert len(first) == 1000
    assert first.sky == 100
    for name, tensor in first.tensors().items():
        assert torch.isfinite(tensor).all(), name
        assert torch.equal(tensor, getattr(second, name)), name
    rendered = render(first, middle(128))
    assert not rendered.invalid.any()
    assert rendered.alpha.mean() > 0.8  # little shines through
