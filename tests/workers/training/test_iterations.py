"""Training as on a card: nothing waits for the device, and what goes wrong there is put right later."""

import math
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass, field, replace
from typing import Any
from unittest import mock

import numpy as np
import pytest
import torch
from torch import Tensor

from panolog.renderer.cuda.parts import Argument, Launch
from panolog.scene.errors import RunError
from panolog.workers.events import Checkpoint, Event
from panolog.workers.specs import Value
from panolog.workers.tasks import Progress
from panolog.workers.training import iterations
from panolog.workers.training.config import TrainConfig
from panolog.workers.training.recipes import RECIPES, Recipe
from panolog.workers.training.trainer import Trainer, TrainSpec, train
from tests.on_device import needs_a_card
from tests.renderer.cuda.emulation import EmulatedLaunch
from tests.renderer.cuda.stubbed import stubbed, without_pairs
from tests.renderer.cuda.waits import counted
from tests.workers.small import WIDTH, small_scene
from tests.workers.trainings import (
    begun,
    block_of,
    coarse_of,
    content,
    end,
    progress_of,
    settings,
    stop_at,
    trained,
    until_saved,
)

ITERATIONS = 12
GROUPS: dict[str, Any] = {
    "sky": {"count": 20},
    "densify": {"until": 25_000, "max_gaussians": 100},
    "reset": {"quiet": 0.2},
    "preview": {"every": 6, "seconds": 1e9},
    "movers": {"weigh": True},
}
STILL = {"densify": {"until": 0}}  # the choices of densification depend on the last bits of a gradient
# Kernels have each with each: tests/renderer/cuda/test_kernels.py.
combined = pytest.mark.parametrize(("projection", "exterior"), [("affine", "none"), ("exact", "baked")])
LEARNS: dict[str, Any] = {
    "exposure": {"learn": True, "begin": 0},
    "poses": {"refine": True, "begin": 0, "visits": 0},
}


@pytest.fixture(autouse=True)
def _one_report(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a whole training, at its end."""
    monkeypatch.setattr("panolog.workers.meter.INTERVAL", math.inf)


@pytest.fixture(scope="module")
def spec(tmp_path_factory: pytest.TempPathFactory) -> TrainSpec:
    scene = small_scene(tmp_path_factory.mktemp("scene"), points=60)
    return coarse_of(scene, settings(**GROUPS), width=WIDTH // 2, iterations=ITERATIONS)


@pytest.fixture(scope="module")
def block(spec: TrainSpec) -> TrainSpec:
    """Half of the scene, of which the other half is baked."""
    return replace(block_of(spec, trained(spec)), views=spec.views)


def changed(spec: TrainSpec, **groups: Any) -> TrainSpec:
    """With other settings, of a block with a baked exterior."""
    baked = {"stage2": {"exterior": "baked"}}
    return replace(spec, config=settings(**GROUPS | (baked if spec.cell else {}) | groups))


@pytest.fixture(scope="module")
def events(spec: TrainSpec) -> list[Event]:
    """Those of an emulated training in which nothing goes wrong."""
    return on_card(spec)


def on_card(spec: TrainSpec) -> list[Event]:
    """The events of an emulated training."""
    with stubbed(Emulated()):
        return list(train(spec))


def saved_first(spec: TrainSpec) -> Mapping[str, Tensor]:
    """What the first checkpoint of a training has."""
    saved = until_saved(spec)
    assert isinstance(saved, Checkpoint)
    return saved.tensors


@pytest.mark.system
def test_a_card_collects_what_the_cpu_does(spec: TrainSpec) -> None:
    """Absolute gradients too."""
    densify = GROUPS["densify"] | {"split_gradient": 1.0, "every_floor": 100}
    task = changed(spec, densify=densify, checkpoint={"every": 5, "share": 1})
    theirs = saved_first(task)
    with stubbed(Emulated()):
        ours = saved_first(task)
    for name in ("gradient", "views", "absolute"):
        one, two = ours[f"statistics.{name}"], theirs[f"statistics.{name}"]
        assert float(two.max()) > 0 and float((one - two).norm() / two.norm()) < 1e-2, name


@pytest.mark.parametrize("where", [nullcontext, lambda: stubbed(Emulated())], ids=["cpu", "emulated"])
def test_nothing_becomes_thinner_than_a_pixel(
    spec: TrainSpec, where: Callable[[], AbstractContextManager[None]]
) -> None:
    optimizer = {"unit": "distance", "least_pixels": 1.0}
    task = changed(spec, optimizer=optimizer, checkpoint={"every": 5, "share": 1})
    with where():
        tensors = saved_first(task)
    scales = tensors["scales"][: len(tensors["scales"]) - int(tensors["sky"])]
    least = (tensors["units.means"][: len(scales)] * 2 * math.pi / spec.width).log()[:, None]
    assert bool((scales >= least - 1e-6).all())
    assert bool(torch.isclose(scales, least).any()) and bool((scales > least + 0.01).any())


@pytest.mark.parametrize("where", [nullcontext, lambda: stubbed(Emulated())], ids=["cpu", "emulated"])
def test_the_sky_becomes_sharp_where_it_is_seen(
    spec: TrainSpec, where: Callable[[], AbstractContextManager[None]]
) -> None:
    groups: dict[str, Any] = {"optimizer": {"unit": "distance"}, "sky": {"count": 200, "sharp": True}}
    with where():
        tensors = saved_first(changed(spec, **groups, checkpoint={"every": 5, "share": 1}))
    scales, distance = tensors["scales"][-200:], tensors["units.means"][-200:, None]
    ratio = scales.exp() / distance / math.sqrt(4 * math.pi / 200)
    assert bool((ratio < 1 + 1e-5).all()) and bool((ratio > 0.7 - 1e-5).all()) and bool((ratio < 0.99).any())
    hidden = tensors["units.scales"][-200:] == 0
    assert bool(hidden.any()) and not bool(hidden.all()) and bool((scales[hidden].std(1) == 0).all())
    assert bool((scales[~hidden].std(1) > 1e-3).any())


def contents(events: list[Event]) -> list[object]:
    """The bytes of checkpoints, previews and the model. When there is progress, depends on the time."""
    return [content(event) for event in events if not isinstance(event, Progress)]


@contextmanager
def small_room(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Room for fewer pairs of splats and tiles than there are."""
    with monkeypatch.context() as patch:
        patch.setattr(iterations, "MARGIN", 0.5)
        patch.setattr(iterations, "_UNSEEN", 0.5)
        patch.setattr(iterations, "_LEAST", 0)
        yield


@pytest.fixture
def waited(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Iterations for which the host has waited."""
    found: list[int] = []
    carefully = iterations.Pipeline._carefully

    def counting(self: iterations.Pipeline, planned: iterations.Planned) -> None:
        found.append(planned.iteration)
        carefully(self, planned)

    monkeypatch.setattr(iterations.Pipeline, "_carefully", counting)
    return found


class Emulated(EmulatedLaunch):
    """The emulation with one order of threads: the same launch has the same result again."""

    def __call__(self, kernel: str, grid: tuple[int, int], block: int, /, **arguments: Argument) -> None:
        self.seed = 0
        super().__call__(kernel, grid, block, **arguments)


@dataclass
class Poisoned:
    """A launch that makes NaN of the sums that a kernel receives, in some of its runs."""

    launch: Launch
    kernel: str
    runs: set[int]  # from 0
    seen: int = field(default=0, init=False)

    def __call__(self, kernel: str, grid: tuple[int, int], block: int, /, **arguments: Argument) -> None:
        if kernel == self.kernel:
            if self.seen in self.runs:
                sums = arguments["sums"]
                assert isinstance(sums, torch.Tensor)
                sums.fill_(torch.nan)
            self.seen += 1
        self.launch(kernel, grid, block, **arguments)


def learns_as_on_the_cpu(spec: TrainSpec) -> None:
    theirs, ours = list(train(spec)), on_card(spec)
    for name in ("loss", "psnr"):
        found, expected = (getattr(progress_of(events)[-1], name) for events in (ours, theirs))
        assert found == pytest.approx(expected, rel=1e-3), name
    one, two = trained(ours).means, trained(theirs).means
    assert len(one) == len(two) and float((two - one).norm() / two.norm()) < 1e-3


@pytest.mark.system
@combined
def test_it_learns_as_on_the_cpu(projection: str, exterior: str, spec: TrainSpec, block: TrainSpec) -> None:
    """Also a block with a baked exterior, whose loss counts active pixels only."""
    task = block if exterior == "baked" else spec
    optimizer = {"unit": "distance" if projection == "exact" else "extent"}
    learns_as_on_the_cpu(changed(task, projection=projection, optimizer=optimizer, **STILL))


@pytest.mark.system
def test_too_little_room_is_put_right(
    spec: TrainSpec, events: list[Event], monkeypatch: pytest.MonkeyPatch, waited: list[int]
) -> None:
    """Checkpoints, previews, densifications and the end follow iterations that had to be repeated."""
    with small_room(monkeypatch):
        assert contents(on_card(spec)) == contents(events)
    assert waited == list(range(1, ITERATIONS + 1))


@pytest.mark.system
def test_a_loss_that_is_not_finite_once_is_put_right(spec: TrainSpec, events: list[Event]) -> None:
    with stubbed(Poisoned(Emulated(), "iteration_guard", {2, 5, 14})):
        assert contents(list(train(spec))) == contents(events)


@pytest.mark.system
@pytest.mark.parametrize("iteration", [1, 2, 5, ITERATIONS])
def test_what_stays_not_finite_ends_the_run_with_a_name(
    iteration: int, spec: TrainSpec, events: list[Event]
) -> None:
    """Nothing that follows the iteration is saved: the events before are those of an undisturbed run."""
    found: list[Event] = []
    loss = iteration == 5
    kernel, what = ("iteration_guard", "loss") if loss else ("project_step", "gradient of means")
    with stubbed(Poisoned(Emulated(), kernel, set(range(iteration - 1, 99)))):
        stream = train(spec)
        with pytest.raises(
            RunError, match=rf"coarse: the {what} is not finite at iteration {iteration}, view pano_"
        ):
            found.extend(stream)  # keeps what came before the error
    before = contents(found)
    assert before == contents(events)[: len(before)]
    assert len(before) == {1: 0, ITERATIONS: 5}.get(iteration, 1)  # there is a preview of iteration 1


@pytest.mark.system
def test_a_stop_saves_iterations_that_had_to_be_repeated(
    spec: TrainSpec, events: list[Event], monkeypatch: pytest.MonkeyPatch
) -> None:
    with stubbed(Emulated()), small_room(monkeypatch):
        *_, saved = train(spec, stop_at(6))
    assert isinstance(saved, Checkpoint) and saved.iteration == 7
    resumed = contents(on_card(replace(spec, checkpoint=Value(saved))))
    assert resumed[-1] == contents(events)[-1]


@contextmanager
def warm(spec: TrainSpec) -> Iterator[tuple[Trainer, Iterator[int]]]:
    """A trainer that has seen each view, and the iterations of which none should wait.

    The first view waits for the number of pairs; each depth map is aligned once.
    """
    with begun(replace(spec, iterations=1000)) as trainer:
        views = [trainer.views.first([row]) for row in spec.views]
        for view in views:
            trainer.step(1, view)

        def steps() -> Iterator[int]:
            for iteration in range(2, 42):
                trainer.step(iteration, trainer.learning.view(views[iteration % len(views)]))
                yield iteration

        yield trainer, steps()


@combined
@pytest.mark.parametrize("kind", ["collects", "still", "learns"])
def test_no_wait_in_a_usual_iteration(
    kind: str, projection: str, exterior: str, spec: TrainSpec, block: TrainSpec
) -> None:
    """The host reads each report, in order, at most `AHEAD` iterations later.

    Poses are learnt from the reports: without pairs their sums mean nothing.
    """
    groups = {} if kind == "collects" else STILL
    groups |= {"exposure": LEARNS["exposure"]} if kind == "learns" else {}
    task = changed(block if exterior == "baked" else spec, projection=projection, **groups)
    with stubbed(without_pairs), warm(task) as (trainer, steps):
        assert isinstance(trainer.pipeline, iterations.Pipeline)
        with counted((trainer.pipeline._reports,)) as found:
            assert all(len(trainer.pipeline._launched) < iterations.AHEAD for _ in steps)
        assert found == {}


@pytest.mark.parametrize("kind", ["coarse", "block"])
def test_no_wait_in_the_default_recipe(kind: str, spec: TrainSpec, block: TrainSpec) -> None:
    """What is baked of a block's exterior comes from its file in each iteration."""
    config = settings(**groups_of("panolog"))
    assert config.loss.sphere and config.stage2.exterior == "baked"
    task = replace(block if kind == "block" else spec, config=config, iterations=1000)
    with stubbed(without_pairs), warm(task) as (trainer, _):
        assert isinstance(trainer.pipeline, iterations.Pipeline)
        with counted((trainer.pipeline._reports,)) as found:
            for iteration in range(2, 202):
                trainer.step(iteration, trainer._view(iteration))
        assert found == {}
        filed = trainer.exterior and trainer.exterior.views._filed
        assert len(filed or ()) == (len(task.views) if kind == "block" else 0)


def groups_of(recipe: Recipe) -> dict[str, Any]:
    """The settings of a recipe that training has."""
    groups: dict[str, Any] = {"sky": {"count": 20}}
    for key, value in RECIPES[recipe].items():
        group, _, name = key.partition(".")
        if group in TrainConfig.model_fields:
            groups[group] = groups.get(group, {}) | {name: value} if name else value
    return groups


def test_the_host_sleeps_while_it_waits_for_an_iteration(
    spec: TrainSpec, monkeypatch: pytest.MonkeyPatch
) -> None:
    made: list[mock.Mock] = []

    def event(*, blocking: bool = False) -> mock.Mock:
        made.append(mock.Mock(blocking=blocking, **{"query.return_value": False}))
        return made[-1]

    monkeypatch.setattr("torch.cuda.Event", event)
    with stubbed(without_pairs), warm(spec) as (trainer, steps):
        assert isinstance(trainer.pipeline, iterations.Pipeline)
        trainer.pipeline._cuda = True
        count = len(list(steps))
    assert [each.blocking for each in made] == [True] * count
    assert sum(each.synchronize.call_count for each in made) == count - iterations.AHEAD + 1


def test_captures_learnt_on_a_card_are_those_of_the_cpu(spec: TrainSpec) -> None:
    learning = changed(spec, **LEARNS)
    ours, theirs = end(on_card(learning)).captured, end(learning).captured
    assert ours is not None and theirs is not None and ours.rows.tolist() == sorted(spec.views)
    for part in ("exposure", "poses"):
        one, other = getattr(ours, part), getattr(theirs, part)
        assert other.any() and np.allclose(one, other, rtol=1e-2, atol=1e-4), part


@needs_a_card
def test_no_wait_on_a_card(spec: TrainSpec) -> None:
    """torch raises where one of its operations would wait."""
    with warm(replace(spec, device="cuda")) as (trainer, steps):
        trainer.settle()
        torch.cuda.set_sync_debug_mode("error")
        try:
            list(steps)
        finally:
            torch.cuda.set_sync_debug_mode("default")
        trainer.settle()


@needs_a_card
def test_too_little_room_on_a_card(spec: TrainSpec, monkeypatch: pytest.MonkeyPatch) -> None:
    """Sums on a card have no fixed order: the result is not that of another run to the byte, but close."""
    task = replace(changed(spec, **STILL), device="cuda")
    usual = progress_of(train(task))[-1]
    with small_room(monkeypatch):
        repeated = progress_of(train(task))[-1]
    assert repeated.loss == pytest.approx(usual.loss, rel=1e-3)
