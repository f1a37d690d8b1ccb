"""Trainings of the small scene, and what they end with."""

from collections.abc import Callable, Iterable, Iterator
from contextlib import closing, contextmanager
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from panolog.partition.bounds import aabb
from panolog.partition.cells import Cell, Grid
from panolog.renderer import ops
from panolog.scene.gaussians import Gaussians
from panolog.scene.model import Scene
from panolog.workers.evaluation import EvaluateSpec
from panolog.workers.events import Checkpoint, Event, Notice, Preview, Scored, Trained
from panolog.workers.scoring import ScoreSpec
from panolog.workers.sound_views import open_cache
from panolog.workers.specs import Value
from panolog.workers.tasks import COARSE, Progress, TaskId
from panolog.workers.training.config import TrainConfig
from panolog.workers.training.trainer import Trainer, TrainSpec, train
from tests.workers.small import WIDTH

# Of 24 iterations it densifies after each 4th one until the 12th, resets after the 9th, saves after each 5th.
SETTINGS: dict[str, dict[str, Any]] = {
    "sky": {"count": 60},
    "densify": {"every_floor": 4, "start": 0, "gradient": 1e-6, "max_gaussians": 260},
    "reset": {"every_floor": 9, "opacity": 0.05},
    "sh": {"every": 6000},
    "checkpoint": {"every": 5, "share": 1},
    "preview": {"every": 8, "seconds": 1e9},
}
RELOCATED: dict[str, Any] = {  # of "densify": growth to a budget
    **{"method": "relocate", "until": 25_000, "growth": 0.3, "weight": "gradient", "long_axis": True},
    **{"measure": "angle", "views": "contribution", "max_gaussians": 0},
}


def settings(**groups: Any) -> TrainConfig:
    """Those above, with some of some groups changed."""
    changed = {
        name: SETTINGS.get(name, {}) | group if isinstance(group, dict) else group
        for name, group in groups.items()
    }
    return TrainConfig.model_validate(SETTINGS | changed)


def coarse_of(scene: Scene, config: TrainConfig | None = None, **fields: Any) -> TrainSpec:
    """Stage I on all views for training. Args: other fields of the spec."""
    spec = TrainSpec(
        task=COARSE,
        scene=Value(scene),
        views=scene.train,
        width=WIDTH,
        iterations=24,
        config=config or settings(),
        seed=3,
    )
    return replace(spec, **fields)


def score_of(scene: Scene, model: Gaussians, views: tuple[int, ...], **fields: Any) -> ScoreSpec:
    """The scores of some views for two blocks, which meet at x = 0. Args: other fields of the spec."""
    labels = (model.means[model.scene, 0] > 0).long().numpy()
    spec = ScoreSpec(
        task=TaskId.shard(0),
        scene=Value(scene),
        views=views,
        width=WIDTH,
        model=Value(model),
        labels=Value(labels),
        blocks=2,
        config=TrainConfig(),
    )
    return replace(spec, **fields)


def scored(spec: ScoreSpec) -> Tensor:
    """(views, blocks) the scores at the end of a task."""
    *_, last = spec.run()
    assert isinstance(last, Scored)
    return last.scores


def evaluation_of(
    scene: Scene, model: Gaussians, views: tuple[int, ...] = (4,), **fields: Any
) -> EvaluateSpec:
    """The measurement of some views. Args: fields of the spec that are others."""
    spec = EvaluateSpec(scene=Value(scene), views=views, width=WIDTH, model=Value(model), near=0.01)
    return replace(spec, **fields)


def block_of(coarse: TrainSpec, initial: Gaussians, **groups: Any) -> TrainSpec:
    """The half of the scene at positive x, seen by the views 0 and 2. Args: groups of settings."""
    cell = Cell(aabb(coarse.scene.load().centers, 5.0), Grid((2, 1, 1)), 1)
    spec = replace(coarse, task=TaskId.block(1), views=(0, 2), initial=Value(initial), cell=cell)
    return replace(spec, config=settings(**groups)) if groups else spec


@contextmanager
def begun(spec: TrainSpec) -> Iterator[Trainer]:
    """A trainer before its first iteration."""
    scene = spec.scene.load()
    with open_cache(spec, scene, spec.views, 2**30) as cache, closing(Trainer(spec, scene, cache)) as trainer:
        list(trainer.begin())
        list(trainer.surround(lambda: False))
        yield trainer


@contextmanager
def threads(count: int) -> Iterator[None]:
    """Within it, torch and our ops use so many threads."""
    before = torch.get_num_threads()
    try:
        torch.set_num_threads(count)
        ops.use_threads(count)
        yield
    finally:
        torch.set_num_threads(before)
        ops.use_threads(None)


def trained(found: TrainSpec | list[Event]) -> Gaussians:
    """The model at the end of a task, or of its events."""
    return end(found).gaussians


def end(found: TrainSpec | list[Event]) -> Trained:
    """The last event."""
    *_, last = train(found) if isinstance(found, TrainSpec) else found
    assert isinstance(last, Trained)
    return last


def stop_at(call: int) -> Callable[[], bool]:
    """What stops a task from one of its calls on, of which the first is 0."""
    calls = iter(range(10_000))
    return lambda: next(calls) >= call


def until_saved(spec: TrainSpec) -> Event:
    """The first checkpoint of a task, with which its training stops, or the last event."""
    stream = train(spec)
    for event in stream:
        if isinstance(event, Checkpoint):
            break
    stream.close()  # type: ignore[attr-defined]
    return event


def content(event: Event) -> object:
    """What can be compared of an event: the bytes of a checkpoint, or all that a task ends with."""
    match event:
        case Checkpoint(_, iteration, tensors):
            return iteration, {name: tensor.numpy().tobytes() for name, tensor in tensors.items()}
        case Trained():
            arrays = {} if event.captured is None else vars(event.captured)
            captured = {name: array.tobytes() for name, array in arrays.items() if array is not None}
            return event.gaussians.sky, bytes_of(event.gaussians), captured
        case Preview(snapshot=Checkpoint() as saved):
            return replace(event, snapshot=None), content(saved)
        case _:
            return event


def bytes_of(gaussians: Gaussians) -> dict[str, bytes]:
    """Of each parameter."""
    return {name: tensor.numpy().tobytes() for name, tensor in gaussians.tensors().items()}


def same(a: Gaussians, b: Gaussians) -> bool:
    """Whether two models are equal to the byte."""
    return a.sky == b.sky and bytes_of(a) == bytes_of(b)


def unchanged(before: dict[str, torch.Tensor], after: dict[str, torch.Tensor]) -> bool:
    """Whether tensors are those of before."""
    return all(torch.equal(after[name], tensor) for name, tensor in before.items())


def checkpoints(events: Iterable[Event]) -> list[Checkpoint]:
    """Those among events."""
    return [event for event in events if isinstance(event, Checkpoint)]


def progress_of(events: Iterable[Event]) -> list[Progress]:
    """Those among events."""
    return [event for event in events if isinstance(event, Progress)]


def notices(events: Iterable[Event]) -> list[str]:
    """Their messages."""
    return [event.message for event in events if type(event) is Notice]
