"""The queue of the user who serves: as the page of all runs shows it, and what the page can do with it."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from panolog.orchestrator.runs.queue.database import DATABASE, opened
from panolog.orchestrator.runs.queue.entries import Entry, State
from panolog.orchestrator.runs.queue.shares import describe
from panolog.orchestrator.runs.queue.view import QueueView, remove_entry, view_queue
from panolog.orchestrator.watch.dashboard.discovery import RunEntry
from panolog.orchestrator.watch.dashboard.messages import QueueList, QueueRow
from panolog.scene.errors import QueueError, in_one_line

QueueAction = Literal["move", "remove", "retry"]
_ENDED = 20  # entries that have ended that are shown, the latest first
_OPEN = 500  # entries that wait or run that are shown


@dataclass(frozen=True)
class QueuePanel:
    """A queue; None of a server that shows none."""

    folder: Path | None
    root: Path  # of the dashboard

    @property
    def exists(self) -> bool:
        """Whether there is anything to show."""
        return self.folder is not None and (self.folder / DATABASE).is_file()

    def read(self) -> QueueList | None:
        """What the page shows; None if there is no queue. One that cannot be read shows why."""
        if self.folder is None or not self.exists:
            return None
        try:
            with opened(self.folder, make=False) as queue:
                view = view_queue(queue)
        except (QueueError, OSError) as error:
            return QueueList(folder=str(self.folder), error=in_one_line(error))
        shown = _shown(view.entries)
        return QueueList(
            folder=str(self.folder),
            runner=view.runner,
            hidden=len(view.entries) - len(shown),
            entries=tuple(self._row(view, entry) for entry in shown),
        )

    def act(self, action: QueueAction, entry: int, before: int | None) -> None:
        """Does what the page requests. Raises QueueError if that is not possible now."""
        if self.folder is None or not self.exists:
            raise QueueError("there is no queue")
        with opened(self.folder, make=False) as queue:
            match action:
                case "move":
                    queue.move(entry, before)
                case "remove":
                    remove_entry(queue, entry)
                case "retry":
                    queue.retry(entry)

    def _row(self, view: QueueView, entry: Entry) -> QueueRow:
        run, id = entry.command.run, None
        below = run.is_relative_to(self.root)
        if below and (run / "run.json").is_file():
            id = RunEntry(self.root, run.relative_to(self.root).as_posix()).id
        return QueueRow(
            id=entry.id,
            name=str(run.relative_to(self.root) if below else run),
            run=id,
            state=entry.state,
            label=view.label(entry),
            reason=view.reason(entry),
            share=describe(entry) if entry.open else "",
            time=entry.ended or entry.began or entry.added,
        )


def _shown(entries: Sequence[Entry]) -> list[Entry]:
    """The entries that run, those that wait, and of the others the latest."""
    running = [entry for entry in entries if entry.state == State.RUNNING]
    waiting = [entry for entry in entries if entry.state == State.WAITING]
    ended = [entry for entry in entries if not entry.open]
    ended.sort(key=lambda entry: -(entry.ended or 0.0))
    return [*[*running, *waiting][:_OPEN], *ended[:_ENDED]]
