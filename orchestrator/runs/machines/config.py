"""Settings of how a run uses its machines."""

from pydantic import Field

from panolog.workers.settings import Group


class DeadlinesConfig(Group):
    """From when on a silent worker counts as hung: it is ended and its task is tried again."""

    hello: float = Field(
        default=600.0,
        gt=0,
        description="seconds from the start of a worker to its first message; on a shared cluster those in"
        " which it waits for its place do not count",
    )
    message: float = Field(
        default=600.0,
        gt=0,
        description="seconds between two messages of a worker, if ten times its usual interval is less",
    )


class QuarantineConfig(Group):
    """When nothing more is placed on a node or a GPU."""

    failures: int = Field(
        default=3,
        ge=1,
        description="failures of different tasks on a node or a GPU, without a success there in between,"
        " after which nothing is placed on it",
    )
    seconds: float = Field(default=3600.0, gt=0, description="seconds after which it is used again")


class ScalingConfig(Group):
    """How many machines a run requests where Ray's autoscaler can start some."""

    overhead: float = Field(
        default=0.1,
        ge=0,
        le=1000,
        description="part of a stage's work that the starts and the idle ends of its machines may cost"
        " besides, for it to be done sooner; 0 = one machine, whatever it takes",
    )
    patience: float = Field(
        default=600.0,
        gt=0,
        description="seconds for which a machine is waited for, before others are requested instead, or tasks"
        " start on those that there are although these seem too small",
    )
