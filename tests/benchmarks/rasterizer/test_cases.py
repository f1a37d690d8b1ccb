"""Models and images to time, and gsplat's side of the comparison, with a stand-in for gsplat."""

from pathlib import Path

import numpy as np
import pytest
import torch

from benchmarks.rasterizer import peers
from benchmarks.rasterizer.cases import BLOCKS, CaseSpec, street, street_case
from panolog.renderer.camera import facing
from panolog.renderer.render import render
from panolog.scene.errors import InputError
from panolog.scene.ply import write_ply
from tests.scenes import WIDTH, write_scene


def test_a_recipe_makes_a_street_or_a_trained_model(tmp_path: Path) -> None:
    scene, model = write_scene(tmp_path / "town"), tmp_path / "model.ply"
    write_ply(model, street(100))
    case = CaseSpec(2 * WIDTH, model=str(model), scene=str(scene), views=2).make()  # larger than its images
    assert (case.name, len(case.gaussians)) == ("trained on town", 100)
    assert [view.target.shape for view in case.views] == [(WIDTH, 2 * WIDTH, 3)] * 2
    assert case.near > 0
    with pytest.raises(InputError, match="nowhere"):
        CaseSpec(64, model="nowhere.ply", scene="nowhere").make()


@pytest.mark.parametrize("exact", [False, True])
def test_a_block_is_a_slab_of_the_street_and_looks_as_the_whole(exact: bool) -> None:
    whole = CaseSpec(128, 800, exact=exact).make()
    for place in BLOCKS:
        case = CaseSpec(128, 800, exact=exact, block=place).make()
        (view,) = case.views
        assert view.around is not None and len(case.gaussians) == 100 and case.gaussians.sky == 0
        along, all_along = case.gaussians.means[:, 0], whole.gaussians.means[whole.gaussians.scene, 0]
        assert float(all_along.max()) in along if place == "far" else float(along.abs().max()) < 5
        parts = render(case.gaussians, view.camera, near=0.0, exterior=view.around).color
        full = render(whole.gaussians, view.camera, near=0.0).color
        active = view.around.active(128, 64)
        assert active.any() and (parts - full).abs()[active].max() < 5e-3
        assert case.to("cpu").views[0].around is not None


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
