"""What the driver needs of wherever tasks run. `ray_pool.RayPool` is the real one."""

from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any, Protocol

from panolog.orchestrator.resources.messages import Message
from panolog.orchestrator.resources.nodes import Node, Place
from panolog.scene.files import Locate
from panolog.workers.events import Event

Work = Callable[..., Iterator[Event]]


class Pool(Protocol):
    """Where tasks run."""

    def nodes(self) -> tuple[Node, ...]:
        """The machines that are there now."""

    def put(self, value: object) -> Any:
        """Shares a value with all tasks."""

    def share_files(self, scene: Iterable[Path], run: Iterable[Path]) -> Locate:
        """How a task finds files of the scene, and files that the run has made."""

    def start(self, name: str, place: Place, work: Work, fields: dict[str, Any]) -> None:
        """Runs `work(**fields)` there."""

    def stop(self, name: str) -> None:
        """Asks a task that has said Hello for a last checkpoint and its end."""

    def wait(self, seconds: float) -> list[tuple[str, Message]]:
        """Messages of running tasks; returns after so many seconds if there are none."""
