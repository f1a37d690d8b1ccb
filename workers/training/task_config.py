"""The settings of training tasks that no model depends on: what they save, show and keep in memory.

Free of torch, as all settings.
"""

from pydantic import Field

from panolog.workers.settings import Group


class CheckpointConfig(Group):
    """When a task can be taken up again."""

    every: int = Field(
        default=1_000,
        ge=1,
        description="iterations as they are between two, at least; a few minutes of work on the CPU",
    )
    share: float = Field(
        default=0.03,
        gt=0,
        le=1,
        description="of a task's time that saving may take: one that is due earlier is skipped; 1 = none is."
        " More than a few percent would be felt",
    )
    interval: float = Field(
        default=60.0,
        ge=0,
        description="seconds between two at least for a task on a GPU, where `every` takes a few seconds;"
        " what a lost process costs at most, and hardly more than its start",
    )


class PreviewConfig(Group):
    """Pictures of the run in progress."""

    every: int = Field(default=500, ge=1, description="iterations as they are between two, a render each")
    seconds: float = Field(
        default=5.0,
        gt=0,
        description="seconds between two at first, besides those of iterations 1, 10, 30, 100, 300; more later,"
        " or where they would take over 1 % of the time",
    )


class CacheConfig(Group):
    """Decoded panoramas in memory."""

    memory: float = Field(
        default=4.0,
        gt=0,
        description="GiB of decoded panoramas one task may keep, a thousand at 1024 pixels width; the default"
        " grows for tasks on GPUs, to half of the machine's free memory for all",
    )
    device: float | None = Field(
        default=None,
        ge=0,
        description="the same on its GPU, besides; none = what the estimate of its training leaves free",
    )


class ImagesConfig(Group):
    """Panoramas that are damaged after the start of a run."""

    damaged: float = Field(
        default=0.05,
        ge=0,
        lt=1,
        description="fraction of a task's panoramas, at least one, that may be undecodable; 0 = none may",
    )
