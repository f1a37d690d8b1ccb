"""Models and images to time."""

from pathlib import Path

import pytest
import torch

from benchmarks.rasterizer.cases import BLOCKS, CaseSpec, street, street_camera
from panolog.renderer.render import render
from panolog.scene.errors import InputError
from panolog.scene.ply import write_ply
from tests.scenes import WIDTH, write_scene


def test_a_recipe_makes_a_street_or_a_trained_model(tmp_path: Path) -> None:
    scene, model = write_scene(tmp_path / "town"), tmp_path / "model.ply"
    write_ply(model, street(100))
    case = CaseSpec(2 * WIDTH, model=str(model), scene=str(scene), views=2).make()  # larger than its images
    assert case.name == "trained on town"
    assert len(case.gaussians) == 100
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
