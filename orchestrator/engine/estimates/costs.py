"""What the stages of a job need, and how long a block takes.

That is learned from the blocks of this run that are done or well on their way:

seconds = c · cameras^a · Gaussians^b · slowness(kind of place), fitted in logarithms by ridge regression
(Bishop, Pattern Recognition and Machine Learning, sec. 3.3). Before anything is measured a = b = 1/10: every
block refines the whole Stage I model for as many iterations, so those with more cameras and Gaussians take
little longer. All places are then equally fast. Each measurement draws these its way.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from panolog.orchestrator.engine.estimates.calibration import Basis
from panolog.orchestrator.runs.state import RunState, Status, TaskState
from panolog.scene.images import MOST_THREADS
from panolog.workers.growth_law import Period
from panolog.workers.tasks import COARSE, Stage, TaskId

_DECODERS = 4  # threads that decode panoramas on the CPU, at most
EXPECTED = 0.1  # a and b: ten recorded runs had 0.0 to 0.1
_NOISE = 0.05  # of the logarithm of a measured time: in those it was 0.02 to 0.04
_SLOWEST = 4.0  # times the estimate: beyond, it was not of this machine
_SPREAD = 0.5  # of a, b and log(slowness) about what is expected before anything is known
_VAGUE = 1e3  # of log(c): anything goes
WELL = 0.05  # of its iterations after which the rate of a running block predicts how long it will take


@dataclass(frozen=True)
class StageEstimate:
    name: Stage
    tasks: int
    together: int  # of them at a time
    gaussians: int  # in one task, sky included
    host: int  # bytes: the peak of one task's process
    device: int  # bytes: the peak of one task on its GPU, 0 on the CPU
    seconds: float | None  # of the whole stage; None = nothing was measured


@dataclass(frozen=True)
class Estimate:
    """What a job needs, and with which blocks."""

    blocks: str
    stages: tuple[StageEstimate, ...]
    disk: int  # bytes of the run folder at its fullest

    @property
    def seconds(self) -> float | None:
        seconds = [stage.seconds for stage in self.stages]
        return None if None in seconds else sum(filter(None, seconds))

    @property
    def memory(self) -> int:
        """Bytes of the largest task, where it computes."""
        return max(stage.device or stage.host for stage in self.stages)

    @property
    def coarse(self) -> int:
        """Gaussians after Stage I, sky included."""
        return next(stage.gaussians for stage in self.stages if stage.name is Stage.COARSE)

    def as_json(self) -> dict[str, Any]:
        return asdict(self) | {"seconds": self.seconds}


@dataclass(frozen=True)
class Pace:
    """Seconds of training, before it has begun: from a calibration, as the module `estimate` says."""

    basis: Basis
    pixels: int  # of a panorama in training
    nodes: int  # machines
    kept: int  # panoramas that stay decoded
    cuda: bool

    def iteration(self, gaussians: int, together: int) -> float:
        """The seconds of an iteration where `together` tasks share the machines."""
        measured = self.basis.measured
        first, second = measured.initial, measured.grown
        if second.gaussians > first.gaussians:
            each = (second.seconds - first.seconds) / (second.gaussians - first.gaussians)
            seconds = first.seconds + max(0.0, each) * (gaussians - first.gaussians)
        else:  # nothing else was affordable: at worst, all of it is for Gaussians
            seconds = first.seconds * gaussians / first.gaussians
        pixels = measured.width * (measured.width // 2)
        return seconds * self.slowdown(together) * max(1.0, self.pixels / pixels)

    def slowdown(self, together: int) -> float:
        """An iteration on a task's part of the cores over one on all: a power of the threads, from two.

        On GPUs `together` counts one task for each, which had as many cores when it was measured.
        """
        measured = self.basis.measured
        if self.cuda or measured.threads == 1 or not measured.grown.seconds:
            return 1.0
        gain = math.log(measured.single / measured.grown.seconds) / math.log(measured.threads)
        threads = max(1, measured.threads * self.nodes // together)
        return float((measured.threads / min(threads, measured.threads)) ** gain)

    def training(self, periods: Sequence[Period], cameras: int, together: int, sky: int) -> float:
        """The seconds of a task. Args: periods of scene Gaussians; sky Gaussians besides."""
        iterations = sum(count for count, _ in periods)
        steps = sum(count * self.iteration(gaussians + sky, together) for count, gaussians in periods)
        decoding = self.decode * (min(cameras, iterations) if self.kept >= cameras else iterations)
        both = max(steps, decoding) if self.cuda else steps + decoding  # on the CPU they share its cores
        return self.basis.measured.begin + both

    @property
    def decode(self) -> float:
        """The seconds of decoding a panorama, of which some are decoded at a time."""
        most = MOST_THREADS if self.cuda else _DECODERS
        return self.basis.measured.decode / min(most, self.basis.measured.threads)


@dataclass(frozen=True)
class BlockTime:
    """One block that was trained in this run."""

    cameras: int
    gaussians: int
    kind: str  # of place, see `nodes.Placement.kind`
    seconds: float  # for all of its iterations


@dataclass(frozen=True)
class CostModel:
    """The fitted coefficients. Made by `fit`."""

    scale: float = 0.0  # log c
    cameras: float = EXPECTED  # the exponent a
    gaussians: float = EXPECTED  # the exponent b
    slowness: tuple[tuple[str, float], ...] = ()  # logarithms by kind of place

    def seconds(self, cameras: int, gaussians: int, kind: str) -> float:
        """What a block with so many cameras and Gaussians takes on a place of a kind."""
        exponent = self.scale + self.cameras * _log(cameras) + self.gaussians * _log(gaussians)
        return math.exp(min(700.0, exponent + dict(self.slowness).get(kind, 0.0)))


def fit(samples: Sequence[BlockTime]) -> CostModel:
    """The model that the samples make most probable."""
    if not samples:
        return CostModel()
    kinds = sorted({sample.kind for sample in samples})
    design = np.array(
        [
            [1.0, _log(s.cameras), _log(s.gaussians), *(float(s.kind == kind) for kind in kinds)]
            for s in samples
        ]
    )
    expected = np.array([0.0, EXPECTED, EXPECTED, *(0.0 for _ in kinds)])
    precision = np.array([1 / _VAGUE, *(1 / _SPREAD,) * (2 + len(kinds))]) ** 2
    residual = np.array([_log(s.seconds) for s in samples]) - design @ expected
    matrix = np.diag(precision) + design.T @ design / _NOISE**2
    scale, a, b, *slow = (expected + np.linalg.solve(matrix, design.T @ residual / _NOISE**2)).tolist()
    return CostModel(scale, a, b, tuple(zip(kinds, slow, strict=True)))


def in_all(samples: Sequence[BlockTime], blocks: Sequence[tuple[int, int]]) -> float:
    """Seconds of all blocks one after another: what is expected before anything is known, to scale.

    The fitted exponents of few samples may be far off for the blocks that are unlike them.

    Args: samples, at least one; blocks, cameras and Gaussians of each.
    """
    expected, kind = CostModel(), samples[0].kind
    measured = sum(expected.seconds(one.cameras, one.gaussians, kind) for one in samples)
    scale = sum(one.seconds for one in samples) / measured
    return scale * sum(expected.seconds(cameras, gaussians, kind) for cameras, gaussians in blocks)


def block_times(state: RunState) -> list[BlockTime]:
    """What the run has measured so far, in the order of the blocks."""
    return [
        BlockTime(block.cameras, block.gaussians, task.place, seconds)
        for block in state.plan or ()
        if (task := state.tasks.get(TaskId.block(block.block))) is not None
        and (seconds := whole_seconds(task)) is not None
    ]


def whole_seconds(task: TaskState) -> float | None:
    """Seconds of a task for all of its iterations, its latest attempt being the measure; None without one."""
    if task.status == Status.DONE and task.seconds and task.iterations and task.iterations > task.begun:
        return task.seconds * task.iterations / (task.iterations - task.begun)
    progress = task.progress
    if task.status == Status.RUNNING and progress is not None and progress.rate > 0:
        well = progress.iteration - task.begun >= WELL * progress.iterations
        return progress.iterations / progress.rate if well else None
    return None


def slowness(state: RunState) -> float:
    """How much longer Stage I takes than was estimated, at least 1: what follows on the machine does too."""
    expected, taken = (state.estimate or {}).get(Stage.COARSE), whole_seconds(state.task(COARSE))
    return min(max(1.0, taken / expected), _SLOWEST) if expected and taken else 1.0


def seconds_left(task: TaskState, predicted: float, running: float) -> float:
    """Seconds that a running task still needs: by its own rate, or by the model before it has one.

    Args: predicted for the whole task; running, seconds since its start.
    """
    progress = task.progress
    if progress is not None and progress.rate > 0 and progress.iteration > task.begun:
        return (progress.iterations - progress.iteration) / progress.rate
    return max(0.0, predicted - running)


def predictor(model: CostModel, cameras: int, gaussians: int) -> Callable[[str], float]:
    """Seconds of one block by kind of place."""
    return lambda kind: model.seconds(cameras, gaussians, kind)


def _log(value: float) -> float:
    return math.log(max(value, 1e-9))
