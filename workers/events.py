"""What workers yield: a stream of typed events, each of which the driver stores.

Every event is a frozen dataclass of plain values and CPU tensors, so that it pickles across machines.
"""

from dataclasses import dataclass

from torch import Tensor

from panolog.scene.gaussians import Gaussians
from panolog.workers.capture.captured import Captured
from panolog.workers.seams.schema import Seam
from panolog.workers.tasks import Progress, TaskId, Transfer


@dataclass(frozen=True, eq=False)
class Checkpoint:
    """All that a task needs to continue as if it had not been interrupted."""

    task: TaskId
    iteration: int
    tensors: dict[str, Tensor]


@dataclass(frozen=True)
class Preview:
    """A rendered panorama above its ground truth, and in Stage I what a 3D view shows of the model then."""

    task: TaskId
    iteration: int
    view: str  # name of the panorama
    jpeg: bytes  # render above ground truth
    held_out: bool = False  # whether no task trains on it
    snapshot: Checkpoint | None = None  # of `training.snapshot`: nothing continues from it


@dataclass(frozen=True)
class Notice:
    """Something the user should read once, such as an image left out of the depth loss."""

    task: TaskId
    message: str


@dataclass(frozen=True)
class LpipsMissing(Notice):
    """Why an evaluation has no LPIPS."""


@dataclass(frozen=True)
class LeftOut(Notice):
    """A panorama that a task leaves out, because it cannot be decoded."""

    view: str  # name of the panorama


@dataclass(frozen=True)
class CheckpointWritten:
    """A worker has written a checkpoint into the task's folder itself; the driver names it."""

    task: TaskId
    iteration: int
    name: str  # of the file
    size: int  # bytes
    seconds: float  # that it took


@dataclass(frozen=True, eq=False)
class Trained:
    """The result of a training task. For a block: already cut to its half-open cell, without sky (eq. 12)."""

    task: TaskId
    gaussians: Gaussians
    iterations: int
    seconds: float  # of training, this attempt
    captured: Captured | None = None  # what Stage I has learnt about its panoramas


@dataclass(frozen=True, eq=False)
class Scored:
    """Gradient scores of a shard of cameras (eq. 10)."""

    task: TaskId
    cameras: tuple[int, ...]  # rows of Scene.panoramas
    scores: Tensor  # (cameras, blocks) float64


@dataclass(frozen=True)
class Evaluated:
    """Metrics of one held-out panorama, and its render."""

    task: TaskId
    view: str
    metrics: dict[str, float | None]
    png: bytes  # the render
    pose_fit: dict[str, float | None] | None = None  # metrics at the fitted pose, and "pixels" from its own


@dataclass(frozen=True)
class SeamMeasured:
    """What was measured at a face between two blocks, and its pictures."""

    task: TaskId
    seam: Seam
    pictures: dict[str, bytes]  # files by name


@dataclass(frozen=True)
class IterationCost:
    """What iterations with so many Gaussians have cost."""

    gaussians: int  # sky included
    seconds: float  # of one iteration, the median
    host: int  # bytes: the peak of the process
    device: int  # bytes: the peak on the GPU, 0 on the CPU


@dataclass(frozen=True)
class Calibration:
    """What a few iterations of a job have measured on one machine: the result of a calibration, no event."""

    width: int  # pixels
    threads: int
    images: int  # bytes of decoded panoramas in memory at both samples
    begin: float  # seconds before the first iteration
    decode: float  # seconds to decode one panorama
    share: float  # of the scene Gaussians, whose mean gradient would densify them
    initial: IterationCost  # the model that training starts with
    grown: IterationCost  # the same after splits, as it may be later
    single: float  # seconds of an iteration with the grown model on one thread
    look: float  # seconds to evaluate one panorama of the grown model; so named in preflight.json


Event = (
    Progress
    | Preview
    | Notice
    | Checkpoint
    | CheckpointWritten
    | Trained
    | Scored
    | Evaluated
    | SeamMeasured
    | Transfer
)
