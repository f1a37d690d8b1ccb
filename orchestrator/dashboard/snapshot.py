"""What is known of a run at one time, packed once for all who are told of it."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

from panolog.orchestrator.dashboard.encoding import encode
from panolog.orchestrator.run.records import Progressed, Stored, as_event

Page = dict[str, Any]
_MOST = 200  # records in a message
_SHORT = ("id", "paused", "stages", "nodes", "actions", "result", "progress", "eta", "now", "latest")


@dataclass(frozen=True)
class Snapshot:
    """A run, or that it cannot be read."""

    version: int = 0  # grows with each change
    row: Page = field(default_factory=dict)  # its row in the list of runs
    page: Page | None = None  # None where it cannot be read: `row["error"]` says why
    data: bytes = b""  # the page as JSON
    whole: int = 0  # version since which nothing but what `changes` has is different
    tasks: dict[str, int] = field(default_factory=dict)  # version in which each task was last different
    news: tuple[Stored, ...] = ()  # the latest records, oldest first
    last: int = 0  # id of the last record
    _changes: dict[int, bytes] = field(default_factory=dict)
    _told: dict[int, bytes] = field(default_factory=dict)

    def changes(self, since: int) -> bytes | None:
        """What is different since a version; None if that is so much that the page is needed whole."""
        if self.page is None or since < self.whole:
            return None
        if since not in self._changes:
            body: Page = self.page["summary"]
            short = {key: value for key, value in body.items() if key not in ("tasks", "blocks")}
            tasks = [task for task in body["tasks"] if self.tasks.get(task["name"], 0) > since]
            head = {key: self.page[key] for key in _SHORT}
            self._changes[since] = encode(head | {"summary": short, "tasks": tasks})
        return self._changes[since]

    def told(self, since: int) -> bytes | None:
        """The records after one, thinned; None if there are none."""
        news = [stored for stored in self.news if stored.id > since]
        if not news:
            return None
        if since not in self._told:
            self._told[since] = encode({"events": thinned(news)})
        return self._told[since]


def thinned(news: Sequence[Stored]) -> list[dict[str, Any]]:
    """Records as the pages get them, newest first: of progress only the latest of each task."""
    latest = {stored.record.task: stored.id for stored in news if isinstance(stored.record, Progressed)}
    kept = [s for s in news if not isinstance(s.record, Progressed) or latest[s.record.task] == s.id]
    return [as_event(stored) for stored in kept[: -_MOST - 1 : -1]]
