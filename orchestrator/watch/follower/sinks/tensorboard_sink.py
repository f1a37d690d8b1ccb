"""TensorBoard: event files in a folder, a run of TensorBoard for each task.

Its numbers are of 32 bits. The files are written and read by the package `tensorboard` alone. What a kill has
cut off at the end of a file is skipped by its reader; a next follower begins a file of its own.
"""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

from tensorboard.backend.event_processing.event_file_loader import EventFileLoader
from tensorboard.compat.proto.event_pb2 import Event
from tensorboard.compat.proto.summary_pb2 import Summary
from tensorboard.plugins.hparams.summary_v2 import hparams_pb
from tensorboard.summary.writer.event_file_writer import EventFileWriter
from typing_extensions import override

from panolog.orchestrator.runs.records import Outcome
from panolog.orchestrator.watch.follower.sinks.interface import Facts, Point, Sink

_OPEN = 64  # files at once
_PATTERN = "events.out.tfevents.*"


class TensorBoardSink(Sink):
    """Args: folder, where TensorBoard is pointed to."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._writers: dict[str, EventFileWriter] = {}

    @override
    def open(self, facts: Facts, known: str) -> str:
        if not known:
            settings = {name: str(value) for name, value in facts.settings.items()}
            self._write("", [Event(summary=hparams_pb(settings, trial_id=facts.id))])
        return facts.id

    @override
    def present(self, task: str, after: int, until: int, names: Sequence[str]) -> set[tuple[str, int]]:
        wanted, found = set(names), set()
        for event in events(self._folder / task):
            for value in event.summary.value:
                if value.tag in wanted and after < event.step <= until:
                    found.add((value.tag, event.step))
        return found

    @override
    def log(self, task: str, points: Sequence[Point]) -> None:
        self._write(
            task,
            [
                Event(
                    wall_time=point.time,
                    step=point.iteration,
                    summary=Summary(value=[Summary.Value(tag=point.name, simple_value=point.value)]),
                )
                for point in points
            ],
        )

    @override
    def finish(self, outcome: Outcome | None, metrics: Mapping[str, float], report: Path | None) -> None:
        """Adds the metrics; the report stays in the run folder."""
        values = [Summary.Value(tag=f"final/{name}", simple_value=value) for name, value in metrics.items()]
        if values:
            self._write("", [Event(summary=Summary(value=values))])
        for writer in self._writers.values():
            writer.close()
        self._writers.clear()

    def _write(self, task: str, events: Sequence[Event]) -> None:
        if task not in self._writers:
            if len(self._writers) >= _OPEN:
                self._writers.pop(next(iter(self._writers))).close()
            self._writers[task] = EventFileWriter(str(self._folder / task))
        writer = self._writers[task]
        for event in events:
            writer.add_event(event)
        writer.flush()


def events(folder: Path) -> Iterator[Event]:
    """All events in a folder, in the order of its files."""
    for path in sorted(folder.glob(_PATTERN)):
        yield from EventFileLoader(str(path)).Load()
