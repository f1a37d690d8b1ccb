"""Training end to end on a scene of five tiny panoramas."""

from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor

from panolog.renderer import iteration
from panolog.renderer.cuda.iteration import Problem
from panolog.renderer.iteration import Seen, forward
from panolog.scene.errors import RunError
from panolog.scene.gaussians import Gaussians, logit
from panolog.scene.images import PanoramaCache
from panolog.scene.model import Scene
from panolog.workers.events import Checkpoint, Event, Preview
from panolog.workers.specs import Value
from panolog.workers.tasks import TaskId
from panolog.workers.training.exterior import inside
from panolog.workers.training.optimizer import AVERAGE
from panolog.workers.training.trainer import Trainer, TrainSpec, train
from tests.on_device import ToDevice
from tests.workers.small import WIDTH
from tests.workers.trainings import (
    begun,
    block_of,
    checkpoints,
    coarse_of,
    end,
    notices,
    progress_of,
    same,
    settings,
    trained,
    unchanged,
)


@pytest.fixture(scope="module")
def coarse(scene: Scene) -> TrainSpec:
    return coarse_of(scene)


@pytest.fixture(scope="module")
def events(coarse: TrainSpec) -> list[Event]:
    """Those of the whole coarse training, to read only."""
    return list(train(coarse))


def sky_of(gaussians: Gaussians) -> dict[str, Tensor]:
    return {name: tensor[gaussians.scene.stop :] for name, tensor in gaussians.tensors().items()}


def test_stage_one_learns(coarse: TrainSpec) -> None:
    calm = settings(reset={"quiet": 1.0}, densify={"prune_scale": 0})
    before, *_ = progress_of(train(replace(coarse, iterations=1)))
    *_, after = progress_of(train(replace(coarse, iterations=150, config=calm)))
    assert before.psnr is not None and after.psnr is not None and after.psnr > before.psnr + 2


def test_stage_one_reports_its_events(coarse: TrainSpec, events: list[Event]) -> None:
    progress = progress_of(events)
    assert progress[-1].iteration == progress[-1].iterations == 24
    assert progress[-1].gaussians == len(trained(events)) and progress[-1].rates["sh0"] == 2.5e-3
    assert [event.iteration for event in checkpoints(events)] == [5, 10, 15, 20]
    assert not any(name.startswith(AVERAGE) for event in checkpoints(events) for name in event.tensors)
    assert not notices(events) and end(events).captured is None


def test_a_cap_holds_from_the_first_iteration_on(coarse: TrainSpec, scene: Scene) -> None:
    most = len(scene.points) // 3
    capped = replace(coarse, config=settings(densify={"max_gaussians": most}))
    counts = [event.gaussians or 0 for event in progress_of(train(capped))]
    assert counts[0] == max(counts) == most + capped.config.sky.count


def test_the_seed_and_depth_matter(coarse: TrainSpec, events: list[Event]) -> None:
    for other in ({"seed": 4}, {"config": settings(depth={"w0": 0.0})}):
        assert not same(trained(events), trained(replace(coarse, **other)))


def test_sky_neither_moves_nor_multiplies_in_stage_one_but_learns(
    coarse: TrainSpec, events: list[Event]
) -> None:
    start, found = trained(replace(coarse, iterations=1)), trained(events)
    assert start.sky == found.sky == 60 and len(found) > 200
    first, last = sky_of(start), sky_of(found)
    assert torch.equal(first["means"], last["means"]) and torch.equal(first["scales"], last["scales"])
    assert not torch.equal(first["sh0"], last["sh0"])
    assert (last["opacities"].sigmoid() > 0.2).all()  # no reset
    assert trained(replace(coarse, config=settings(sky={"count": 0}), iterations=2)).sky == 0


def test_what_never_rose_after_the_last_reset_is_no_haze(coarse: TrainSpec, events: list[Event]) -> None:
    *_, late = (replace(c, tensors=dict(c.tensors)) for c in checkpoints(events))  # after the last reset
    late.tensors["opacities"] = late.tensors["opacities"].clone()
    late.tensors["opacities"][:40] = logit(0.003)  # below 1/255: no view draws it, none gives it a gradient
    ceiling = coarse.config.reset.opacity
    whole = trained(replace(coarse, checkpoint=Value(late)))
    assert whole.sky == 60 and (whole.opacities[whole.scene].sigmoid() > ceiling).all()
    block = trained(block_of(coarse, trained(events)))
    assert len(block) > 0 and (block.opacities.sigmoid() > ceiling).all()


@pytest.mark.parametrize("kind", ["full", "frozen"])
def test_a_block_keeps_only_its_cell_and_leaves_the_sky_alone(
    kind: str, coarse: TrainSpec, events: list[Event]
) -> None:
    """With a frozen exterior also all that is outside of its cell."""
    initial = trained(events)
    before = {name: tensor.clone() for name, tensor in initial.tensors().items()}
    task = block_of(coarse, initial, stage2={"exterior": kind})
    found = list(train(task))
    assert task.cell is not None
    block = trained(found)
    assert block.sky == 0 and 0 < len(block) < len(initial)
    assert task.cell.contains(block.means.numpy()).all()
    assert (block.opacities.sigmoid() > 0.005).all()
    still = ~task.cell.contains(initial.means.numpy()) & (kind == "frozen")
    still[initial.scene.stop :] = True
    *_, final = checkpoints(found)
    for name, tensor in initial.tensors().items():
        expected = tensor[torch.from_numpy(still)]
        assert torch.equal(final.tensors[name][-len(expected) :], expected), name
    assert unchanged(before, initial.tensors())


def test_resets_bound_a_block_softly(coarse: TrainSpec, events: list[Event]) -> None:
    """A reset of a block clamps its Gaussians outside of the cell, too (app. D)."""
    initial = trained(events)
    high = replace(initial, opacities=torch.full_like(initial.opacities, 3.0))
    task = block_of(coarse, high, densify={"until": 30_000, "gradient": 1e3})
    with begun(task) as trainer:
        list(trainer.run(lambda: trainer.iteration == 9))
    gaussians = trainer.state.gaussians
    assert not inside(gaussians, task.cell).all()
    assert not (gaussians.opacities[gaussians.scene] > logit(0.05)).any()


def test_each_densification_draws_other_numbers(coarse: TrainSpec, monkeypatch: pytest.MonkeyPatch) -> None:
    drawn: list[float] = []
    name = "panolog.workers.training.relocate.densify"
    monkeypatch.setattr(name, lambda *arguments: drawn.append(arguments[-1].random()))
    list(train(coarse))
    assert len(drawn) == len({*drawn}) > 1


def test_what_is_not_finite_ends_the_run_with_a_name(
    coarse: TrainSpec, monkeypatch: pytest.MonkeyPatch
) -> None:
    def poisoned(problem: Problem) -> Seen:
        seen = forward(problem)
        return seen._replace(color=seen.color * float("nan"))

    monkeypatch.setattr(iteration, "forward", poisoned)
    with pytest.raises(RunError, match=r"coarse: the loss is not finite at iteration 1, view pano_\d\.png"):
        list(train(coarse))


def test_invalid_gaussians_are_removed_with_a_notice(coarse: TrainSpec) -> None:
    first = next(event for event in train(coarse) if isinstance(event, Checkpoint))
    first.tensors["means"][7, 0] = float("nan")
    events = list(train(replace(coarse, checkpoint=Value(first))))
    (notice,) = notices(events)
    assert notice.startswith("1 Gaussians were not finite at iteration 8")
    assert all(torch.isfinite(tensor).all() for tensor in trained(events).tensors().values())


def test_images_left_out_of_the_depth_loss_are_named(coarse: TrainSpec) -> None:
    scene = coarse.scene.load()
    panoramas = tuple(replace(panorama, observed=panorama.observed[:5]) for panorama in scene.panoramas)
    events = train(replace(coarse, scene=Value(replace(scene, panoramas=panoramas)), iterations=8))
    assert sorted(notice.split(" ")[0] for notice in notices(events)) == [f"pano_{i}.png" for i in range(4)]


def test_the_unit_of_length_does_not_matter(coarse: TrainSpec, scene: Scene) -> None:
    """As long as the depth loss does not depend on it, which it does as eq. 5 is printed."""
    coarse, kilo = replace(coarse, config=settings(depth={"unit": "baseline"})), 1000.0
    poses = tuple(replace(p, translation=p.translation * kilo) for p in scene.panoramas)
    larger = replace(scene, panoramas=poses, points=scene.points * kilo)
    specs = (replace(coarse, scene=Value(other), iterations=4) for other in (scene, larger))
    found = [list(train(spec)) for spec in specs]  # the last iteration densifies
    (*_, first), (*_, second) = map(progress_of, found)
    assert first.loss is not None and second.loss == pytest.approx(first.loss, rel=1e-4)
    assert first.gaussians == second.gaussians
    one, other = map(trained, found)
    assert torch.allclose(one.means * kilo, other.means, atol=1e-2 * kilo)
    assert torch.allclose(one.opacities, other.opacities, atol=1e-3)


def test_what_is_no_task_is_refused(coarse: TrainSpec, events: list[Event]) -> None:
    """A checkpoint of another one, half of a block, and nothing to see."""
    with pytest.raises(RunError, match="does not continue coarse"):
        next(train(replace(coarse, checkpoint=Value(Checkpoint(TaskId.block(0), 5, {})))))
    saved = next(event for event in events if isinstance(event, Checkpoint))
    for other in ({"projection": "exact"}, {"optimizer": {"unit": "distance"}}):
        spec = replace(coarse, checkpoint=Value(saved), config=settings(**other))
        with pytest.raises(RunError, match=r"projection=affine and optimizer\.unit=extent"):
            next(train(spec))
    block = block_of(coarse, trained(events))
    with pytest.raises(ValueError, match="needs both"):
        replace(coarse, cell=block.cell)
    for task in (coarse, block):
        with pytest.raises(ValueError, match="no views"):
            replace(task, views=())


def test_a_preview_shows_a_view_that_is_on_a_device(
    coarse: TrainSpec, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene, shown = coarse.scene.load(), []
    on_device: tuple[dict[str, Any], ...] = ({"device": "cuda", "mover": ToDevice()}, {})
    for options in on_device:
        with PanoramaCache(scene, coarse.views, WIDTH, 1, **options) as cache:
            trainer = Trainer(replace(coarse, iterations=1), scene, cache)
            list(trainer.begin())
            monkeypatch.setattr(trainer, "step", lambda *_: None)  # one of the CPU takes no such view
            shown += [event for event in trainer.run(lambda: False) if isinstance(event, Preview)]
    assert len(shown) == 2 and shown[0] == shown[1]
