"""Training as on a card: nothing waits for the device, and what goes wrong there is put right later."""

import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace

import numpy as np
import pytest
import torch

from panolog.partition.bounds import aabb
from panolog.partition.cells import Cell, Grid
from panolog.renderer.cuda.parts import Argument, Launch
from panolog.scene.errors import RunError
from panolog.scene.images import PanoramaCache
from panolog.scene.model import Scene
from panolog.workers.capture.config import ExposureConfig, MoversConfig, PosesConfig
from panolog.workers.events import Checkpoint, Event, Progress, Trained
from panolog.workers.sound_views import open_cache
from panolog.workers.specs import Value
from panolog.workers.tasks import COARSE, TaskId
from panolog.workers.training import pipeline
from panolog.workers.training.config import DensifyConfig, PyramidConfig, TrainConfig
from panolog.workers.training.trainer import Trainer, TrainSpec, train
from tests.renderer.cuda.emulation import EmulatedLaunch
from tests.renderer.cuda.stubbed import stubbed, without_pairs
from tests.renderer.cuda.waits import counted
from tests.workers.small import WIDTH, small_scene

ITERATIONS = 12
CONFIG = TrainConfig.model_validate(
    {
        "sky": {"count": 20},
        "densify": {"every_floor": 4, "start": 0, "until": 25_000, "gradient": 1e-6, "max_gaussians": 100},
        "reset": {"every_floor": 9, "opacity": 0.05, "quiet": 0.2},
        "sh": {"every": 6000},
        "checkpoint": {"every": 5, "share": 1},
        "preview": {"every": 6},
        "movers": {"weigh": True},
    }
)


@pytest.fixture(scope="module")
def spec(tmp_path_factory: pytest.TempPathFactory) -> TrainSpec:
    scene = small_scene(tmp_path_factory.mktemp("scene"), points=60)
    return TrainSpec(
        task=COARSE,
        scene=Value(scene),
        views=scene.train,
        width=WIDTH // 2,
        iterations=ITERATIONS,
        config=CONFIG,
        seed=3,
    )


@pytest.fixture(scope="module")
def events(spec: TrainSpec) -> list[Event]:
    """Those of an emulated training in which nothing goes wrong."""
    with stubbed(Emulated()):
        return list(train(spec))


def contents(events: list[Event]) -> list[object]:
    """The bytes of checkpoints, previews and the model. When there is progress, depends on the time."""
    return [_content(event) for event in events if not isinstance(event, Progress)]


def last(events: list[Event]) -> Progress:
    """The last progress."""
    return [event for event in events if isinstance(event, Progress)][-1]


def _content(event: Event) -> object:
    match event:
        case Checkpoint(_, iteration, tensors):
            return iteration, {name: tensor.numpy().tobytes() for name, tensor in tensors.items()}
        case Trained():
            return {n: tensor.numpy().tobytes() for n, tensor in event.gaussians.tensors().items()}
        case _:
            return event


@contextmanager
def small_room(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Room for fewer pairs of splats and tiles than there are."""
    with monkeypatch.context() as patch:
        patch.setattr(pipeline, "MARGIN", 0.5)
        patch.setattr(pipeline, "_UNSEEN", 0.5)
        patch.setattr(pipeline, "_LEAST", 0)
        yield


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


@pytest.mark.system
@pytest.mark.parametrize("projection", ["affine", "exact"])
def test_it_learns_as_on_the_cpu(projection: str, spec: TrainSpec, monkeypatch: pytest.MonkeyPatch) -> None:
    """Without densification: its choices depend on the last bits of a gradient."""

    monkeypatch.setattr("panolog.workers.meter.INTERVAL", math.inf)
    changes = {"densify": DensifyConfig(until=0), "projection": projection}
    calm = replace(spec, config=CONFIG.model_copy(update=changes))
    theirs = last(list(train(calm)))
    with stubbed(Emulated()):
        ours = last(list(train(calm)))
    assert ours.loss == pytest.approx(theirs.loss, rel=1e-3)
    assert ours.psnr == pytest.approx(theirs.psnr, rel=1e-3)


@pytest.fixture(scope="module")
def block(spec: TrainSpec) -> TrainSpec:
    """Half of the scene, of which the other half is baked."""
    *_, last = train(spec)
    assert isinstance(last, Trained)
    cell = Cell(aabb(spec.scene.load().centers, 5.0), Grid((2, 1, 1)), 1)
    config = TrainConfig.model_validate(CONFIG.model_dump() | {"stage2": {"exterior": "baked"}})
    return replace(spec, task=TaskId.block(1), config=config, initial=Value(last.gaussians), cell=cell)


@pytest.mark.system
@pytest.mark.parametrize("projection", ["affine", "exact"])
def test_a_block_with_a_baked_exterior_learns_as_on_the_cpu(
    projection: str, block: TrainSpec, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its loss counts active pixels only, in the same way."""
    monkeypatch.setattr("panolog.workers.meter.INTERVAL", math.inf)
    changes = {"densify": DensifyConfig(until=0), "projection": projection}
    calm = replace(block, config=block.config.model_copy(update=changes))
    theirs = list(train(calm))
    with stubbed(Emulated()):
        ours = list(train(calm))
    assert last(ours).loss == pytest.approx(last(theirs).loss, rel=1e-3)
    assert last(ours).psnr == pytest.approx(last(theirs).psnr, rel=1e-3)
    one, two = (events[-1] for events in (ours, theirs))
    assert isinstance(one, Trained) and isinstance(two, Trained)
    moved = (two.gaussians.means - one.gaussians.means).norm() / two.gaussians.means.norm()
    assert len(one.gaussians) == len(two.gaussians) and float(moved) < 1e-3


@pytest.mark.system
def test_too_little_room_is_put_right(
    spec: TrainSpec, events: list[Event], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Checkpoints, previews, densifications and the end follow iterations that had to be repeated."""
    repeated: list[int] = []
    carefully = pipeline.Pipeline._carefully

    def counting(self: pipeline.Pipeline, plan: pipeline.Plan) -> None:
        repeated.append(plan.iteration)
        carefully(self, plan)

    monkeypatch.setattr(pipeline.Pipeline, "_carefully", counting)
    with stubbed(Emulated()), small_room(monkeypatch):
        assert contents(list(train(spec))) == contents(events)
    assert repeated == list(range(1, ITERATIONS + 1))


@pytest.mark.system
def test_what_is_not_finite_once_is_put_right(spec: TrainSpec, events: list[Event]) -> None:
    gradients = Poisoned(Emulated(), "project_backward", {2, 9})
    with stubbed(Poisoned(gradients, "iteration_guard", {5, 14})):
        assert contents(list(train(spec))) == contents(events)


@pytest.mark.system
@pytest.mark.parametrize("iteration", [1, 4, 5, ITERATIONS])
def test_what_stays_not_finite_ends_the_run_with_a_name(
    iteration: int, spec: TrainSpec, events: list[Event]
) -> None:
    """Nothing that follows the iteration is saved: the events before are those of an undisturbed run."""
    found: list[Event] = []
    loss = iteration == 5
    kernel, what = ("iteration_guard", "loss") if loss else ("project_backward", "gradient of means")
    with stubbed(Poisoned(Emulated(), kernel, set(range(iteration - 1, 99)))):
        stream = train(spec)
        with pytest.raises(
            RunError, match=rf"coarse: the {what} is not finite at iteration {iteration}, view pano_"
        ):
            found.extend(stream)  # keeps what came before the error
    before = contents(found)
    assert before == contents(events)[: len(before)]
    assert len(before) == (3 if iteration == ITERATIONS else 0)


@pytest.mark.system
def test_a_stop_saves_iterations_that_had_to_be_repeated(
    spec: TrainSpec, events: list[Event], monkeypatch: pytest.MonkeyPatch
) -> None:
    with stubbed(Emulated()), small_room(monkeypatch):
        *_, saved = train(spec, stop=iter([False] * 6 + [True]).__next__)
    assert isinstance(saved, Checkpoint) and saved.iteration == 7
    with stubbed(Emulated()):
        resumed = contents(list(train(replace(spec, checkpoint=Value(saved)))))
    assert resumed[-1] == contents(events)[-1]


@pytest.mark.system
def test_a_pyramid_learns_as_on_the_cpu(spec: TrainSpec, monkeypatch: pytest.MonkeyPatch) -> None:
    """The pairs of a smaller view are not those of a larger one: the first of each size waits for them."""
    monkeypatch.setattr("panolog.workers.meter.INTERVAL", math.inf)
    changes = {"densify": DensifyConfig(until=0), "pyramid": PyramidConfig(steps=(0.5,))}
    pyramid = replace(spec, config=CONFIG.model_copy(update=changes), width=WIDTH)
    carefully, waited = pipeline.Pipeline._carefully, []

    def counting(self: pipeline.Pipeline, plan: pipeline.Plan) -> None:
        waited.append((plan.iteration, plan.problem.camera.width))
        carefully(self, plan)

    monkeypatch.setattr(pipeline.Pipeline, "_carefully", counting)
    theirs = last(list(train(pyramid)))
    with stubbed(Emulated()):
        ours = last(list(train(pyramid)))
    assert waited == [(1, WIDTH // 2), (7, WIDTH)]
    assert ours.loss == pytest.approx(theirs.loss, rel=1e-3)


@contextmanager
def trainer_of(spec: TrainSpec, launch: Launch) -> Iterator[Trainer]:
    scene: Scene = spec.scene.load()
    with stubbed(launch), PanoramaCache(scene, spec.views, spec.width, 2**30) as cache:
        trainer = Trainer(spec, scene, cache)
        trainer.begin()
        yield trainer


@pytest.mark.parametrize("projection", ["affine", "exact"])
@pytest.mark.parametrize("collects", [True, False])
@pytest.mark.parametrize("exterior", ["none", "baked"])
def test_no_wait_in_a_usual_iteration(
    collects: bool, projection: str, exterior: str, spec: TrainSpec, block: TrainSpec
) -> None:
    """The host reads each report, in order, at most `AHEAD` iterations later."""
    spec = block if exterior == "baked" else spec
    densify = CONFIG.densify if collects else DensifyConfig(until=0)
    config = spec.config.model_copy(update={"densify": densify, "projection": projection})
    with trainer_of(replace(spec, config=config, iterations=1000), without_pairs) as trainer:
        views = [trainer.views.first([row]) for row in spec.views]
        assert isinstance(trainer.pipeline, pipeline.Pipeline)
        for view in views:  # the first waits for the number of pairs; each depth map is aligned once
            trainer.step(1, view)
        with counted((trainer.pipeline._reports,)) as found:
            for iteration in range(2, 42):
                trainer.step(iteration, views[iteration % len(views)])
                assert len(trainer.pipeline._launched) < pipeline.AHEAD
        assert found == {}


LEARNS = {
    "exposure": ExposureConfig(learn=True, begin=0),
    "movers": MoversConfig(weigh=True),
    "poses": PosesConfig(refine=True, begin=0, visits=0),
}


def test_no_wait_where_captures_are_learnt(spec: TrainSpec) -> None:
    """Poses are learnt from the reports: without pairs their sums mean nothing."""
    still = LEARNS | {"poses": PosesConfig(), "densify": DensifyConfig(until=0)}
    config = spec.config.model_copy(update=still)
    with trainer_of(replace(spec, config=config, iterations=1000), without_pairs) as trainer:
        views = [trainer.views.first([row]) for row in spec.views]
        assert isinstance(trainer.pipeline, pipeline.Pipeline)
        for view in views:
            trainer.step(1, view)
        with counted((trainer.pipeline._reports,)) as found:
            for iteration in range(2, 42):
                trainer.step(iteration, trainer.learning.view(views[iteration % len(views)]))
        assert found == {}


def test_captures_learnt_on_a_card_are_those_of_the_cpu(spec: TrainSpec) -> None:
    learning = replace(spec, config=spec.config.model_copy(update=LEARNS))
    theirs = list(train(learning))[-1]
    with stubbed(Emulated()):
        ours = list(train(learning))[-1]
    assert isinstance(ours, Trained) and isinstance(theirs, Trained)
    assert ours.captured is not None and theirs.captured is not None
    for part in ("exposure", "poses"):
        one, other = getattr(ours.captured, part), getattr(theirs.captured, part)
        assert other.any() and np.allclose(one, other, rtol=1e-2, atol=1e-4), part


@pytest.mark.cuda
@pytest.mark.skipif(not torch.cuda.is_available(), reason="there is no CUDA card")
def test_no_wait_on_a_card(spec: TrainSpec) -> None:
    """torch raises where one of its operations would wait."""
    long = replace(spec, device="cuda", iterations=1000)
    scene = long.scene.load()
    with open_cache(long, scene, long.views, 2**30) as cache:
        trainer = Trainer(long, scene, cache)
        trainer.begin()
        views = [trainer.views.first([row]) for row in long.views]
        for view in views:  # the first waits for the number of pairs; each depth map is aligned once
            trainer.step(1, view)
        trainer.settle()
        torch.cuda.set_sync_debug_mode("error")
        try:
            for iteration in range(2, 42):
                trainer.step(iteration, views[iteration % len(views)])
        finally:
            torch.cuda.set_sync_debug_mode("default")
        trainer.settle()


@pytest.mark.cuda
@pytest.mark.skipif(not torch.cuda.is_available(), reason="there is no CUDA card")
def test_too_little_room_on_a_card(spec: TrainSpec, monkeypatch: pytest.MonkeyPatch) -> None:
    """Sums on a card have no fixed order: the result is not that of another run to the byte, but close."""
    config = CONFIG.model_copy(update={"densify": DensifyConfig(until=0)})
    on_card = replace(spec, device="cuda", config=config)
    monkeypatch.setattr("panolog.workers.meter.INTERVAL", math.inf)

    usual = last(list(train(on_card)))
    with small_room(monkeypatch):
        repeated = last(list(train(on_card)))
    assert repeated.loss == pytest.approx(usual.loss, rel=1e-3)
