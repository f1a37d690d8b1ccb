"""The tasks of a run, their names, and what they report in plain values.

Imports no torch: a run folder is read without it.
"""

import re
from dataclasses import dataclass, field
from enum import Enum
from functools import lru_cache

from panolog.scene.errors import InputError

NOTHING_HELD_OUT = "no panorama is held out (holdout=none), so quality is not measured"


class StrEnum(str, Enum):
    """An enumeration of words, each equal to its text: as `enum.StrEnum` of Python 3.11."""

    def __str__(self) -> str:
        return str(self.value)


class Stage(StrEnum):
    """A stage of a run, in order; `PREPARE` and `CALIBRATE` precede it."""

    PREPARE = "prepare"  # the scene, of panoramas or of a video
    CALIBRATE = "calibrate"  # a few iterations, to estimate time and memory
    DISTRICT = "district"  # Stage I of a part of the place
    COARSE = "coarse"  # Stage I; of several districts their union
    SCORE = "score"  # gradient scores of a shard of the cameras (eq. 10)
    PLAN = "plan"  # the partition (eqs. 7-11)
    BLOCK = "block"  # Stage II, one block
    UNION = "union"  # all blocks as they are in one model, parts of which are then trained once more
    ROUND = "round"  # a block once more, among the others as they are now
    REPAIR = "repair"  # what is near a face between two blocks once more, of both together
    MERGE = "merge"
    MEASURE = "measure"  # a shard of the evaluation: some held-out panoramas or faces
    EVAL = "eval"  # the metrics of all; without levels of detail also what they are measured by
    DELIVER = "deliver"  # files for viewers

    @property
    def trains(self) -> bool:
        """Whether its tasks train, and so have previews, checkpoints and models of their own."""
        return self.refines or self in (Stage.DISTRICT, Stage.COARSE)

    @property
    def refines(self) -> bool:
        """Whether its tasks train a part of a model that remains as it was if the task fails."""
        return self in (Stage.BLOCK, Stage.ROUND, Stage.REPAIR)

    @property
    def in_shards(self) -> bool:
        """Whether its tasks are shards of one result, which the driver then puts together."""
        return self in (Stage.SCORE, Stage.MEASURE)


AFTER_TRAINING = (Stage.MERGE, Stage.MEASURE, Stage.EVAL, Stage.DELIVER)  # also one that a limit has ended
_NUMBERED = (Stage.DISTRICT, Stage.SCORE, Stage.BLOCK, Stage.UNION, Stage.ROUND, Stage.REPAIR, Stage.MEASURE)
_ORDER = {stage: position for position, stage in enumerate(Stage)}
_NAME = re.compile(r"([a-z]+)(?:/(\d{3,9}))?")


@dataclass(frozen=True)
class TaskId:
    """One task, in text such as "coarse" or "block/003": a stage, and a number where it has several tasks.

    Ids are ordered by stage, then by number. Raises ValueError if a number is missing, negative or excessive.
    """

    stage: Stage
    index: int | None = None  # of the district, the shard, the block or the face; None for the other stages

    def __post_init__(self) -> None:
        if (self.index is None) == (self.stage in _NUMBERED) or (self.index or 0) < 0:
            raise ValueError(f"{self.stage} has no task with the number {self.index}")

    def __str__(self) -> str:
        return self.stage.value if self.index is None else f"{self.stage.value}/{self.index:03d}"

    def __lt__(self, other: "TaskId") -> bool:
        return self.order < other.order

    @property
    def order(self) -> tuple[int, int]:
        return _ORDER[self.stage], self.index or 0

    @property
    def number(self) -> int:
        """`index` where there is one. Raises ValueError for the other stages."""
        if self.index is None:
            raise ValueError(f"{self} has no number")
        return self.index

    @staticmethod
    def district(index: int) -> "TaskId":
        """Stage I of a district."""
        return TaskId(Stage.DISTRICT, index)

    @staticmethod
    @lru_cache(maxsize=2**15)
    def block(index: int) -> "TaskId":
        """The training of a block."""
        return TaskId(Stage.BLOCK, index)

    @staticmethod
    def union(number: int) -> "TaskId":
        """What `number` passes over the blocks' union have come to."""
        return TaskId(Stage.UNION, number)

    @staticmethod
    def round(block: int) -> "TaskId":
        """The second training of a block."""
        return TaskId(Stage.ROUND, block)

    @staticmethod
    def repair(face: int) -> "TaskId":
        """The training of what is near a face."""
        return TaskId(Stage.REPAIR, face)

    @staticmethod
    def shard(index: int) -> "TaskId":
        """The scoring of a shard of the training cameras."""
        return TaskId(Stage.SCORE, index)

    @staticmethod
    def measure(index: int) -> "TaskId":
        """A shard of the evaluation."""
        return TaskId(Stage.MEASURE, index)

    @staticmethod
    @lru_cache(maxsize=2**14)
    def parse(text: str) -> "TaskId":
        """The inverse of `str`. Raises InputError for any other text."""
        match = _NAME.fullmatch(text)
        if match is not None and match[1] in list(Stage):
            index = None if match[2] is None else int(match[2])
            stage = Stage(match[1])
            if (index is None) != (stage in _NUMBERED) and str(task := TaskId(stage, index)) == text:
                return task
        known = "district/000, coarse, score/000, plan, block/003, union/000, round/003, repair/000, merge,"
        raise InputError(f"{text!r} is not a task: write {known} measure/000, eval or deliver")


PREPARE = TaskId(Stage.PREPARE)
CALIBRATE = TaskId(Stage.CALIBRATE)
COARSE = TaskId(Stage.COARSE)
PLAN = TaskId(Stage.PLAN)
MERGE = TaskId(Stage.MERGE)
EVAL = TaskId(Stage.EVAL)
DELIVER = TaskId(Stage.DELIVER)


@dataclass(frozen=True)
class Progress:
    """The progress of a task, about once a second."""

    task: TaskId
    iteration: int  # done so far
    iterations: int  # in all
    rate: float  # iterations per second, recent
    loss: float | None = None  # mean since the last one
    psnr: float | None = None  # dB, mean over the training views since the last one
    gaussians: int | None = None
    memory: int | None = None  # bytes: of the device on CUDA, resident of the process on the CPU
    host_peak: int | None = None  # bytes: the peak resident size of the process since the task began
    rates: dict[str, float] = field(default_factory=dict)  # learning rates by parameter


@dataclass(frozen=True)
class Transfer:
    """What a task has moved between machines since the last one of these."""

    task: TaskId
    received: int  # bytes: panoramas, models, checkpoints
    sent: int  # bytes: models, checkpoints, pictures
