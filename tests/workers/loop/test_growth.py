"""Growth strategies on torch's optimizers do what those of the trainer do, and keep each row's moments."""

from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from panolog.renderer.camera import Camera
from panolog.renderer.rasterize import Raster, rasterize
from panolog.scene.gaussians import concatenate
from panolog.workers.loop.growth import Clone3DGS, Relocate
from tests.renderer.hard_scenes import camera, cloud

SKY = 10
CENTERS = np.random.default_rng(0).normal(size=(8, 3))
OFTEN: dict[str, Any] = {
    "start": 0,
    "every": 1,
    "every_floor": 2,
}  # of a run of 20 iterations: after each second one


def start() -> tuple[dict[str, Tensor], torch.optim.Adam]:
    """Leaves with a sky, and their optimizer."""
    sky = cloud(SKY, seed=1)
    model = concatenate(cloud(60), sky.with_tensors(sky.tensors(), sky=SKY))
    leaves = {name: tensor.clone().requires_grad_() for name, tensor in model.tensors().items()}
    return leaves, torch.optim.Adam([{"params": [leaf], "lr": 1e-3} for leaf in leaves.values()])


def rasterized(leaves: dict[str, Tensor], *cameras: Camera) -> Raster:
    means, quats, scales, opacities, sh0, rest = leaves.values()
    return rasterize(means, quats, scales, opacities, cameras, sh=torch.cat([sh0, rest], 1))


def step(leaves: dict[str, Tensor], optimizer: torch.optim.Adam) -> Raster:
    raster = rasterized(leaves, camera(64), camera(64, seed=1))
    optimizer.zero_grad()
    (raster.color - 0.5).abs().mean().backward()  # type: ignore[no-untyped-call]
    optimizer.step()
    return raster


def moments(leaves: dict[str, Tensor], optimizer: torch.optim.Adam, name: str) -> Tensor:
    found: Tensor = optimizer.state[leaves[name]]["exp_avg"]
    return found


def consistent(leaves: dict[str, Tensor], optimizer: torch.optim.Adam) -> bool:
    """Whether the optimizer has these leaves and no others, with moments of their shapes."""
    owned = [parameter for group in optimizer.param_groups for parameter in group["params"]]
    same = [one is other for one, other in zip(owned, leaves.values(), strict=True)]
    shapes = [moments(leaves, optimizer, name).shape == leaf.shape for name, leaf in leaves.items()]
    known = len(optimizer.state) == len(leaves)
    return all(same) and all(shapes) and known and all(leaf.requires_grad for leaf in leaves.values())


def test_clones_have_no_moments_and_others_keep_theirs() -> None:
    leaves, optimizer = start()
    growth = Clone3DGS(CENTERS, 20, sky=SKY, gradient=1e-6, percent_dense=1.0, prune_opacity=0.0, **OFTEN)
    growth.step(leaves, optimizer, step(leaves, optimizer), 1)
    assert len(leaves["means"]) == 70  # no turn of it
    raster = step(leaves, optimizer)
    before = {name: leaf.detach().clone() for name, leaf in leaves.items()}
    kept = {name: moments(leaves, optimizer, name).clone() for name in leaves}
    growth.step(leaves, optimizer, raster, 2)
    added = len(leaves["means"]) - 70
    assert 0 < added <= 60
    assert consistent(leaves, optimizer)
    for name, leaf in leaves.items():
        assert torch.equal(leaf[:60], before[name][:60])
        assert torch.equal(leaf[-SKY:], before[name][-SKY:])
        assert torch.equal(moments(leaves, optimizer, name)[:60], kept[name][:60])
        assert not moments(leaves, optimizer, name)[60:-SKY].any()
        assert torch.equal(moments(leaves, optimizer, name)[-SKY:], kept[name][-SKY:])
    step(leaves, optimizer)  # and the optimizer continues
    assert (optimizer.state[leaves["means"]]["step"]) == 3


def test_relocation_fills_a_budget() -> None:
    leaves, optimizer = start()
    with torch.no_grad():
        leaves["opacities"][:20] = -9.0  # transparent
    growth = Relocate(CENTERS, 20, sky=SKY, growth=1.0, filled=0.1, max_gaussians=80, **OFTEN)
    for iteration in range(1, 9):
        growth.step(leaves, optimizer, step(leaves, optimizer), iteration)
        assert consistent(leaves, optimizer)
    assert len(leaves["means"]) == 80 + SKY
    assert (leaves["opacities"][:80] > -9).all()


def test_resets_clamp_opacities_and_moments_of_the_scene() -> None:
    leaves, optimizer = start()
    none = {"gradient": 1e9, "prune_opacity": 0.0, "prune_scale": 0.0, **OFTEN}
    growth = Clone3DGS(CENTERS, 20, sky=SKY, reset={"every": 1, "every_floor": 4, "opacity": 0.01}, **none)
    for iteration in range(1, 5):
        growth.step(leaves, optimizer, step(leaves, optimizer), iteration)
    opacities = torch.sigmoid(leaves["opacities"])
    assert (opacities[:-SKY] <= 0.01 + 1e-6).all()
    assert (opacities[-SKY:] > 0.02).any()
    assert not moments(leaves, optimizer, "opacities")[:-SKY].any()
    assert moments(leaves, optimizer, "opacities")[-SKY:].any()


def test_it_says_what_is_missing() -> None:
    leaves, optimizer = start()
    with pytest.raises(ValueError, match="no_such_setting"):
        Clone3DGS(CENTERS, 20, no_such_setting=1)
    with pytest.raises(ValueError, match="split_gradient is of absolute gradients"):
        Clone3DGS(CENTERS, 20, split_gradient=4e-4)
    raster = rasterized(leaves, camera(64))
    with pytest.raises(ValueError, match="call backward"):
        Clone3DGS(CENTERS, 20, sky=SKY).step(leaves, optimizer, raster, 1)
    raster, some = step(leaves, optimizer), {name: leaf for name, leaf in leaves.items() if name != "shN"}
    with pytest.raises(ValueError, match="has no shN"):
        Clone3DGS(CENTERS, 20, sky=SKY).step(some, optimizer, raster, 1)


def test_what_an_optimizer_has_by_row_must_be_known() -> None:
    leaves, _ = start()
    optimizer = torch.optim.Adam(list(leaves.values()), amsgrad=True)
    with pytest.raises(ValueError, match="max_exp_avg_sq of means"):
        Clone3DGS(CENTERS, 20, sky=SKY, **OFTEN).step(leaves, optimizer, step(leaves, optimizer), 2)


def test_what_does_not_train_stays_so() -> None:
    leaves, optimizer = start()
    raster = step(leaves, optimizer)
    leaves["quats"].requires_grad_(False)
    Clone3DGS(CENTERS, 20, sky=SKY, gradient=1e-6, **OFTEN).step(leaves, optimizer, raster, 2)
    assert [name for name, leaf in leaves.items() if not leaf.requires_grad] == ["quats"]


def test_what_of_the_sky_is_not_finite_is_removed() -> None:
    leaves, optimizer = start()
    growth = Clone3DGS(CENTERS, 20, sky=SKY, gradient=1e9, prune_opacity=0.0, prune_scale=0.0, **OFTEN)
    for iteration in range(1, 5):
        raster = step(leaves, optimizer)
        with torch.no_grad():
            leaves["means"][-iteration] = torch.nan if iteration == 2 else 1.0
        growth.step(leaves, optimizer, raster, iteration)
    assert len(leaves["means"]) == 69 and growth._sky == SKY - 1
