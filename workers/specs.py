"""What every task of a worker is described by: a frozen spec, which the driver makes and the worker runs.

A spec is small. What is large, or lies in a file of the driver's machine, is a `Source` in it: the worker
loads the value when it runs the spec.
"""

from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Generic, Protocol, TypeVar

from panolog.scene.files import Locate, here
from panolog.scene.gaussians import Gaussians
from panolog.scene.model import Cloud, Scene
from panolog.scene.ply import read_ply
from panolog.workers.events import Calibration, Event
from panolog.workers.tasks import TaskId

T = TypeVar("T")
T_co = TypeVar("T_co", covariant=True)


class Source(Protocol[T_co]):
    """A value that a worker loads on the machine where it runs."""

    def load(self) -> T_co:
        """The value."""


@dataclass(frozen=True, eq=False)
class Value(Generic[T]):
    """The value itself, for tasks in the process that has it."""

    value: T

    def load(self) -> T:
        """The value."""
        return self.value


@dataclass(frozen=True)
class ModelFile:
    """The model in a PLY."""

    path: Path
    locate: Locate = here  # where the file is on this machine

    def load(self) -> Gaussians:
        """Reads it. Raises InputError if it is no PLY of Gaussians."""
        return read_ply(self.locate(self.path))


@dataclass(frozen=True, eq=False)
class ScenePart:
    """A scene with no more of its sparse cloud than a task needs: a city's would not fit every machine."""

    panoramas: Source[Scene]  # `Scene.without_points`, which all tasks share
    cloud: Cloud

    def load(self) -> Scene:
        """The scene with that part of the cloud."""
        return self.cloud.within(self.panoramas.load())


@dataclass(frozen=True, eq=False, kw_only=True)
class TaskSpec(ABC):
    """What all specs have."""

    task: TaskId
    scene: Source[Scene]
    width: int  # pixels of the panoramas; height is width / 2
    device: str = "cpu"
    locate: Locate = here  # where the panoramas are
    taken: int = 0  # bytes of its GPU that it was to have, and that others have taken

    @abstractmethod
    def run(self) -> Iterator[Event | Calibration]:
        """Does the task, in a worker. Yields what the driver is to know of it, as it happens."""
