"""What each task asks of a machine: from the scene, the plan and what the run has measured so far."""

from collections.abc import Callable, Iterable, Mapping
from functools import cached_property
from typing import Any

from panolog.orchestrator.driver.job import Job
from panolog.orchestrator.resources.basis import basis_of
from panolog.orchestrator.resources.costs import CostModel, predictor, seconds_left
from panolog.orchestrator.resources.estimate import Estimator
from panolog.orchestrator.resources.nodes import Place
from panolog.orchestrator.resources.placement import Request, Running
from panolog.orchestrator.run.config import RunConfig
from panolog.orchestrator.run.records import BlockPlan
from panolog.orchestrator.run.state import RunState, block_task
from panolog.scene.ply import ply_header

_SMALLER = 1 / 4  # of the image cache, after a shortage of memory


class Requests:
    """Makes the requests of tasks at one moment of a run."""

    def __init__(self, sizes: "Sizes", state: RunState, model: CostModel) -> None:
        self._sizes = sizes
        self._state = state
        self._model = model
        self._blocks: Mapping[str, BlockPlan] = {block_task(b.block): b for b in state.plan or ()}

    def of(self, names: Iterable[str]) -> list[Request]:
        """What tasks that wait ask for."""
        return [self._request(name) for name in names]

    def running(self, places: Mapping[str, Place], now: float) -> list[Running]:
        """Where tasks run, and for how long they still do. Args: now, seconds since the epoch."""
        return [Running(place, self._left(name, place, now)) for name, place in places.items()]

    def _request(self, name: str) -> Request:
        task = self._state.task(name)
        more_than = task.starved if task.shortages > 1 else 0
        memory = self._sizes.of(name)
        return Request(name, memory, self._seconds(name), alone=task.shortages > 0, more_than=more_than)

    def _seconds(self, name: str) -> Callable[[str], float]:
        block = self._blocks.get(name)
        return _one if block is None else predictor(self._model, block.cameras, block.gaussians)

    def _left(self, name: str, place: Place, now: float) -> float:
        task = self._state.task(name)
        return seconds_left(task, self._seconds(name)(place.kind), now - (task.since or now))


class Sizes:
    """Bytes that tasks need, roughly: of a GPU, or of a node for a job on the CPU."""

    def __init__(self, job: Job) -> None:
        self._job = job

    def of(self, name: str) -> int:
        """Those of one task."""
        stage = name.partition("/")[0]
        if stage == "coarse":
            return self._coarse
        return self._block if stage == "block" else self._look

    @cached_property
    def _estimator(self) -> Estimator:
        job = self._job
        return Estimator(job.scene, job.config, basis_of(job.folder, job.scene, job.config), ())

    @cached_property
    def _coarse(self) -> int:
        estimator = self._estimator
        return estimator.memory(estimator.estimate().stages[0].gaussians, self._cameras)

    @cached_property
    def _block(self) -> int:
        refined = self._estimator.refined(self._gaussians)
        return self._estimator.memory(refined, self._cameras, initial=self._gaussians)

    @cached_property
    def _look(self) -> int:
        """Scoring and evaluation."""
        host, device = self._estimator.look(self._gaussians, self._cameras)
        return device or host

    @cached_property
    def _gaussians(self) -> int:
        """What Stage I came to."""
        return ply_header(self._job.folder.model("coarse"))[0]

    @property
    def _cameras(self) -> int:
        return len(self._job.scene.train)


def spare(fields: Mapping[str, Any], shortages: int) -> dict[str, Any]:
    """The fields of a task, with a smaller image cache after a shortage of memory."""
    config: RunConfig | None = fields.get("config")
    if not shortages or config is None:
        return dict(fields)
    cache = config.cache.model_copy(update={"memory": config.cache.memory * _SMALLER})
    return {**fields, "config": config.model_copy(update={"cache": cache})}


def _one(_: str) -> float:
    return 1.0
