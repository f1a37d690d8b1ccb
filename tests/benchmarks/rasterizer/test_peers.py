"""gsplat's side of the comparison, with a stand-in for gsplat."""

from typing import Any

import numpy as np
import pytest
import torch

from benchmarks.rasterizer import peers
from benchmarks.rasterizer.cases import street_case
from panolog.renderer.camera import facing


def test_the_faces_look_where_they_are_resampled_from() -> None:
    """A point in the direction of a pixel of a face is projected to this pixel."""
    case = street_case(50, 64)
    camera = case.views[0].camera
    lens = peers.face(64)
    assert lens.focal == pytest.approx(64 / (2 * np.pi), rel=0.1)  # as fine as the panorama
    given = peers.arguments(case.gaussians, camera, lens)
    for view, K, turn in zip(given["viewmats"], given["Ks"], peers.FACES, strict=True):
        pixel = torch.tensor([3.5, 9.5, 1.0])
        ray = torch.linalg.inv(K) @ pixel
        in_panorama = torch.from_numpy(facing(*turn)).float() @ ray
        point = camera.rotation.T @ (7 * in_panorama - camera.translation)
        seen = K @ (view[:3, :3] @ point + view[:3, 3])
        assert torch.allclose(seen / seen[2], pixel, atol=1e-3)
    assert given["colors"].shape == (50, 16, 3)
    assert (given["scales"] > 0).all() and (given["opacities"] < 1).all()


def test_rows_of_both(monkeypatch: pytest.MonkeyPatch) -> None:
    """The stand-in returns grey faces."""

    def rasterization(**given: Any) -> tuple[torch.Tensor, None, dict[str, torch.Tensor]]:
        shape = (len(given["viewmats"]), given["height"], given["width"], 3)
        return given["means"].sum() * 0 + torch.full(shape, 0.5), None, {"flatten_ids": torch.zeros(321)}

    monkeypatch.setattr(peers, "load_gsplat", lambda: rasterization)
    case = street_case(200, 64)
    ours, panorama = peers.ours(case, repeats=1)
    theirs = peers.theirs(case, 1, panorama)
    assert (ours.images, ours.pixels) == (1, 64 * 32)
    assert ours.pairs >= int(case.gaussians.opacities.shape[0] / 4)
    assert (theirs.images, theirs.pixels, theirs.pairs) == (6, 6 * 23 * 23, 321)
    assert theirs.psnr is not None and 0 < theirs.psnr < 40
    assert "gsplat" in peers.table([ours, theirs])
