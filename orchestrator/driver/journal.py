"""What a run has done: records in its database, and the state that they make."""

from collections.abc import Sequence

from panolog.orchestrator.run.records import Record
from panolog.orchestrator.run.state import OnChange, RunState, apply, ignore, replay
from panolog.orchestrator.run.store import Database


class Journal:
    """The only way in which a driver changes the state of its run."""

    def __init__(self, database: Database, on_change: OnChange = ignore) -> None:
        """Args: on_change, called after each record that is stored, and often without one."""
        self.database = database
        self.on_change = on_change
        self.state: RunState = replay(database.milestones())

    def record(self, records: Sequence[Record]) -> None:
        """Stores records in one transaction and shows them. Raises sqlite3.Error if that is impossible."""
        stored = self.database.append(records) if records else []
        if stored:
            self.state = apply(self.state, stored)
        self.on_change(self.state, stored)
