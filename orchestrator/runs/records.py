"""What a run has done so far: what the driver has made of `workers.events`, each once its files are there."""

from dataclasses import dataclass, field

from panolog.orchestrator.runs.money.records import OfMoney, OfRun
from panolog.workers.tasks import CALIBRATE, DELIVER, EVAL, MERGE, PLAN, Progress, StrEnum, TaskId, Transfer


class Failure(StrEnum):
    """Why an attempt failed. `policy.after_failure` decides what follows."""

    ERROR = "error"  # the task itself: trying again may help
    INPUT = "input"  # what the user gave: trying again is pointless
    MEMORY = "memory"  # there was not enough of it
    LOST = "lost"  # its process or its machine is gone: the task need not be the cause


class Leaving(StrEnum):
    """Why a node leaves."""

    PREEMPTION = "preemption"  # its provider takes it away
    TERMINATION = "termination"  # its owner has it deleted
    MAINTENANCE = "maintenance"  # its provider stops or restarts it
    REBALANCE = "rebalance"  # a pre-emption has become likely, without a date
    DRAIN = "drain"  # Ray starts nothing more there


class Outcome(StrEnum):
    """How a driver has ended."""

    DONE = "done"
    FAILED = "failed"
    INTERRUPTED = "interrupted"
    LIMITED = "limited"  # a limit of cost or time has ended its training early; the rest is done


class Part(StrEnum):
    """What a notice is about if not a task."""

    PREFLIGHT = "preflight"
    CONTROL = "control"
    REPORT = "report"


@dataclass(frozen=True)
class RunBegan(OfRun):
    """A driver has taken the run over."""

    host: str
    pid: int
    resumed: bool
    previous: float | None = None  # seconds since the epoch: the last record of the driver before
    code: str = ""  # `info.own_code` of its version
    settings: dict[str, object] = field(default_factory=dict)  # of run.json, if that was resolved by then


@dataclass(frozen=True)
class Preparing:
    """What a driver does before its first task."""

    step: str  # for people: "starting Ray", "calibrating"
    task: TaskId = CALIBRATE  # or PREPARE, while it makes the scene


@dataclass(frozen=True)
class PreflightSaved:
    """The needs of the run are estimated, and its settings are resolved."""

    path: str  # relative to the run folder, as all paths here
    seconds: dict[str, float | None]  # expected of each stage; None = not known
    settings: dict[str, object] = field(default_factory=dict)  # those of run.json from now on
    task: TaskId = CALIBRATE


@dataclass(frozen=True)
class TaskStarted:
    """A worker has begun a task, or continued it from a checkpoint."""

    task: TaskId
    attempt: int  # 1 for the first
    iteration: int  # of the checkpoint it continues from
    node: str  # its host name
    pid: int
    device: str
    threads: int
    place: str = ""  # kind of place, all equally fast: see `nodes.Placement.kind`
    cache: float | None = None  # GiB of decoded panoramas it may keep
    node_id: str = ""  # Node.id, as in the records below
    card: str = ""  # Node.card of its GPU


@dataclass(frozen=True)
class Progressed(Progress):
    """Where a task stands, as its worker has said."""


@dataclass(frozen=True)
class PreviewSaved:
    """A panorama was rendered in training, with its photograph."""

    task: TaskId
    iteration: int
    view: str
    path: str
    held_out: bool = False  # whether no task trains on it


@dataclass(frozen=True)
class Noticed:
    """Something that the user should read once."""

    task: TaskId | Part | None  # None: the whole run
    message: str


@dataclass(frozen=True)
class CheckpointSaved:
    """A task can continue from here."""

    task: TaskId
    iteration: int
    path: str
    size: int  # bytes


@dataclass(frozen=True)
class ModelSaved:
    """A training task has ended and its Gaussians are in a PLY."""

    task: TaskId
    path: str
    gaussians: int
    size: int  # bytes
    iterations: int
    seconds: float  # of training in the attempt that ended it


@dataclass(frozen=True)
class ScoresSaved:
    """The gradient scores of one shard of cameras are on disk (eq. 10)."""

    task: TaskId
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
    passes: tuple[tuple[str, ...], ...] = ()  # tasks that train parts of the blocks' union once more
    measures: int = 0  # shards of the evaluation; 0 = it is one task
    task: TaskId = PLAN


@dataclass(frozen=True)
class TaskFailed:
    """An attempt has ended badly; `final` when no other follows."""

    task: TaskId
    attempt: int
    reason: str  # one line
    final: bool
    detail: str = ""  # the traceback of an unexpected error
    kind: Failure = Failure.ERROR
    memory: int = 0  # bytes that its place had
    then: str = ""  # what is done about it, if there is more to say than whether it is tried again
    node: str = ""  # Node.id of its place
    excused: bool = False  # its place is in quarantine, so it does not count against the task
    preempted: bool = False  # its node had announced that it leaves: it counts apart
    card: str = ""  # Node.card of its GPU


@dataclass(frozen=True)
class Merged:
    """The one PLY is in place."""

    path: str
    gaussians: int
    sky: int
    size: int  # bytes
    seconds: float
    task: TaskId = MERGE


@dataclass(frozen=True)
class ViewEvaluated:
    """One held-out panorama was compared with its render."""

    task: TaskId
    view: str
    metrics: dict[str, float | None]


@dataclass(frozen=True)
class SeamEvaluated:
    """A face between two blocks was looked at."""

    task: TaskId
    face: str  # its blocks: "0|1"
    seam: float | None  # as in seams.json


@dataclass(frozen=True)
class MeasuresSaved:
    """What one shard of the evaluation has measured is on disk."""

    task: TaskId
    path: str
    views: int  # held-out panoramas, those that were left out too
    faces: int


@dataclass(frozen=True)
class EvaluationSaved:
    """The metrics of the merged model are in place."""

    path: str
    metrics: dict[str, float | None]  # means over the held-out panoramas
    task: TaskId = EVAL


@dataclass(frozen=True)
class Delivered:
    """The merged model is there as files for viewers."""

    path: str  # of the folder that a browser shows; "" if it could not be made, which a notice explains
    size: int  # bytes of all files
    seconds: float
    task: TaskId = DELIVER


@dataclass(frozen=True)
class Transferred(Transfer):
    """What a task on another machine than the driver's has moved, as its worker has said."""


@dataclass(frozen=True)
class StopRequested(OfRun):
    """The user requests the run to stop; tasks that train write a last checkpoint."""

    tasks: int  # that train


@dataclass(frozen=True)
class PauseRequested:
    """The user requests a block to wait; if it trains, it writes a last checkpoint."""

    task: TaskId


@dataclass(frozen=True)
class UnpauseRequested:
    """The user requests a paused block to continue."""

    task: TaskId


@dataclass(frozen=True)
class RetryRequested:
    """The user requests a block to have all its attempts again."""

    task: TaskId


@dataclass(frozen=True)
class TaskYielded:
    """A task has ended early, after a checkpoint, as requested."""

    task: TaskId
    leaves: str = ""  # host of its node, if the task moves because that leaves


@dataclass(frozen=True)
class RunWaiting(OfRun):
    """The run waits: its disk is full or cannot be reached, or there is no machine for its tasks."""

    reason: str  # for people: what is wrong, and what to do about it


@dataclass(frozen=True)
class RunContinued(OfRun):
    """The run does not wait any more."""

    seconds: float  # that the run has waited


@dataclass(frozen=True)
class NodeQuarantined(OfRun):
    """Nothing more is placed on a node or a GPU, as different tasks have failed there one after another."""

    node: str  # Node.id or Node.card
    host: str  # with the GPU, if that alone is meant
    reason: str  # one line
    until: float  # seconds since the epoch
    tasks: tuple[str, ...] = ()  # whose failures there do not count


@dataclass(frozen=True)
class NodeReleased(OfRun):
    """A node or a GPU in quarantine is used again."""

    node: str  # Node.id or Node.card
    host: str  # with the GPU, if that alone is meant
    reason: str = ""  # one line


@dataclass(frozen=True)
class NodeLeaving(OfRun):
    """A node has announced that it leaves: nothing more is placed there, and its tasks save and move."""

    node: str  # Node.id
    host: str
    kind: Leaving
    seconds: float | None = None  # until it leaves; None = not known


@dataclass(frozen=True)
class NodeStaying(OfRun):
    """The announcement was withdrawn: the node is used again."""

    node: str  # Node.id
    host: str


@dataclass(frozen=True)
class NodeLeft(OfRun):
    """A node that had announced it has left."""

    node: str  # Node.id
    host: str


@dataclass(frozen=True)
class RunEnded(OfRun):
    """A driver has ended."""

    outcome: Outcome
    reason: str = ""
    transient: bool = False  # the cause need not be the run itself: another driver may succeed
    detail: str = ""  # the traceback of an unexpected error


OfDriver = RunBegan | Preparing | PreflightSaved | RunWaiting | RunContinued | RunEnded
OfAttempt = TaskStarted | Progressed | PreviewSaved | CheckpointSaved | Transferred | TaskYielded | TaskFailed
Result = ModelSaved | ScoresSaved | PlanSaved | Merged | MeasuresSaved | EvaluationSaved | Delivered
Request = StopRequested | PauseRequested | UnpauseRequested | RetryRequested
OfNode = NodeQuarantined | NodeReleased | NodeLeaving | NodeStaying | NodeLeft
Record = OfDriver | OfAttempt | Result | ViewEvaluated | SeamEvaluated | Noticed | Request | OfNode | OfMoney


@dataclass(frozen=True)
class Stored:
    """A record with its place in the run's history."""

    id: int
    time: float  # seconds since the epoch
    record: Record


def task_name(record: Record) -> str:
    """The task of a record as the database has it: "" for the whole run."""
    return str(record.task or "")
