"""What a run has done so far, as typed records: one row of the database each, without tensors.

`workers.events` is what workers say; a record is what the driver has made of it, once the files it names are
in place. Nothing here imports torch or Ray, so that looking at a run starts at once.
"""

import json
from dataclasses import dataclass, field
from typing import Any

RUN = ""  # the task of records that concern the run as a whole

# Why an attempt failed. What follows from each is `policy.after_failure`'s to say.
ERROR = "error"  # the task itself: trying again may help
INPUT = "input"  # what the user gave: trying again is pointless
MEMORY = "memory"  # there was not enough of it
LOST = "lost"  # its process or its machine is gone: the task need not be to blame


@dataclass(frozen=True)
class RunBegan:
    """A driver has taken the run over."""

    host: str
    pid: int
    resumed: bool
    task: str = RUN


@dataclass(frozen=True)
class TaskStarted:
    """A worker has begun a task, or gone on with it from a checkpoint."""

    task: str
    attempt: int  # 1 for the first
    iteration: int  # of the checkpoint it goes on from
    node: str
    pid: int
    device: str
    threads: int
    place: str = ""  # kind of place, all equally fast: see `nodes.Place.kind`
    cache: float | None = None  # GiB of decoded panoramas it may keep


@dataclass(frozen=True)
class Progressed:
    """Where a task stands; the fields are those of `workers.events.Progress`."""

    task: str
    iteration: int
    iterations: int
    rate: float  # iterations per second
    loss: float | None = None
    psnr: float | None = None  # dB over training views
    gaussians: int | None = None
    memory: int | None = None  # bytes
    host_peak: int | None = None  # bytes
    rates: dict[str, float] = field(default_factory=dict)  # learning rates by parameter


@dataclass(frozen=True)
class PreviewSaved:
    """A training view was rendered beside its truth."""

    task: str
    iteration: int
    view: str
    path: str  # relative to the run folder, as all paths here


@dataclass(frozen=True)
class Noticed:
    """Something that the user should read once."""

    task: str
    message: str


@dataclass(frozen=True)
class CheckpointSaved:
    """A task can go on from here."""

    task: str
    iteration: int
    path: str
    size: int  # bytes


@dataclass(frozen=True)
class ModelSaved:
    """A training task has ended and its Gaussians are in a PLY."""

    task: str
    path: str
    gaussians: int
    size: int  # bytes
    iterations: int
    seconds: float  # of training in the attempt that ended it


@dataclass(frozen=True)
class ScoresSaved:
    """The gradient scores of one shard of cameras are on disk (eq. 10)."""

    task: str
    path: str
    cameras: int


@dataclass(frozen=True)
class BlockPlan:
    """One block of the plan: what it weighs and whether it is trained at all."""

    block: int
    cameras: int
    gaussians: int  # of the Stage I model inside its cell
    train: bool  # False: it keeps its Stage I Gaussians, because no camera is assigned or it is empty


@dataclass(frozen=True)
class PlanSaved:
    """The partition is decided (eqs. 7-11)."""

    path: str
    blocks: tuple[BlockPlan, ...]
    task: str = "plan"


@dataclass(frozen=True)
class TaskFailed:
    """An attempt has ended badly; `final` when no other follows."""

    task: str
    attempt: int
    reason: str  # one line
    final: bool
    detail: str = ""  # the traceback, where nobody has foreseen the failure
    kind: str = ERROR
    memory: int = 0  # bytes that its place had
    then: str = ""  # what is done about it, if there is more to say than whether it is tried again


@dataclass(frozen=True)
class Merged:
    """The one PLY is in place."""

    path: str
    gaussians: int
    sky: int
    size: int  # bytes
    seconds: float
    task: str = "merge"


@dataclass(frozen=True)
class ViewEvaluated:
    """One held-out panorama was compared with its render."""

    task: str
    view: str
    metrics: dict[str, float | None]


@dataclass(frozen=True)
class EvaluationSaved:
    """The metrics of the merged model are in place."""

    path: str
    metrics: dict[str, float | None]  # means over the held-out panoramas
    task: str = "eval"


@dataclass(frozen=True)
class Transferred:
    """What a task on another machine than the driver's has moved since the last one of these."""

    task: str
    received: int  # bytes
    sent: int  # bytes


@dataclass(frozen=True)
class StopRequested:
    """Somebody wants the run to stop; tasks that train are asked for a last checkpoint."""

    tasks: int  # that were asked
    task: str = RUN


@dataclass(frozen=True)
class PauseRequested:
    """Somebody wants a block to wait; if it trains it is asked for a last checkpoint."""

    task: str


@dataclass(frozen=True)
class UnpauseRequested:
    """Somebody wants a block that was to wait to go on."""

    task: str


@dataclass(frozen=True)
class RetryRequested:
    """Somebody wants a block to have all its attempts again."""

    task: str


@dataclass(frozen=True)
class TaskYielded:
    """A task has ended early, after a checkpoint, as it was asked to."""

    task: str


@dataclass(frozen=True)
class RunEnded:
    """A driver has let go of the run: "done", "failed" or "interrupted"."""

    outcome: str
    reason: str = ""
    task: str = RUN


Record = (
    RunBegan
    | TaskStarted
    | Progressed
    | PreviewSaved
    | Noticed
    | CheckpointSaved
    | ModelSaved
    | ScoresSaved
    | PlanSaved
    | TaskFailed
    | Merged
    | ViewEvaluated
    | EvaluationSaved
    | Transferred
    | StopRequested
    | PauseRequested
    | UnpauseRequested
    | RetryRequested
    | TaskYielded
    | RunEnded
)
_TYPES: dict[str, type[Any]] = {kind.__name__: kind for kind in Record.__args__}


@dataclass(frozen=True)
class Stored:
    """A record with its place in the run's history."""

    id: int
    time: float  # seconds since the epoch
    record: Record


def to_json(record: Record) -> str:
    """The fields of a record; its type is stored beside it."""
    return json.dumps(vars(record), default=vars, allow_nan=False, separators=(",", ":"))


def as_event(stored: Stored) -> dict[str, Any]:
    """A record with its place in the history, for other programs."""
    head = {"id": stored.id, "time": stored.time, "type": type(stored.record).__name__}
    return head | vars(stored.record)


def as_line(stored: Stored) -> str:
    """The same as one line of JSON."""
    return json.dumps(as_event(stored), default=vars, allow_nan=False)


def from_json(kind: str, text: str) -> Record:
    """The inverse of `to_json`. Raises KeyError for a type that this version does not know."""
    fields = json.loads(text)
    if kind == PlanSaved.__name__:
        fields["blocks"] = tuple(BlockPlan(**block) for block in fields["blocks"])
    record: Record = _TYPES[kind](**fields)
    return record
