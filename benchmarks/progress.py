"""The progress that a run shows against the share of its time that is over, from its records.

    python -m benchmarks.progress RUN [RUN ...] [--svg FILE] [--json]
    python -m benchmarks.progress RUN --follow

Each record is replayed, and what the page, the terminal and the notifications would have shown at its time
is compared with the time until then over that of the whole run, waits left out of both. The goal is that it
is never more than 10 points away once a minute is over, in any run. Of a preparation the records say nothing:
`--follow` looks at a run every two seconds until it ends.
"""

import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from matplotlib.axes import Axes

from benchmarks import report
from benchmarks.paper.curves import standalone, svg
from benchmarks.runs import history
from panolog.orchestrator.runs.folder import RunFolder
from panolog.orchestrator.runs.records import Stored
from panolog.orchestrator.runs.state import RunState, apply, replay
from panolog.orchestrator.watch.views.palette import BLOCK_COLORS
from panolog.orchestrator.watch.views.preparation import view_preparation
from panolog.orchestrator.watch.views.summary import summarize
from panolog.orchestrator.watch.views.timing import elapsed, progress_of
from panolog.scene.errors import InputError
from panolog.scene.files import write_bytes

GOAL = 0.1  # of progress, 0 to 1
SETTLED_S = 60.0  # seconds of work after which the goal holds
_LOOK_S = 2.0


@dataclass(frozen=True)
class Moment:
    """A run at the time of one of its records."""

    seconds: float  # of work until then
    over: float  # share of the time of the whole run, 0 to 1
    shown: float  # progress, 0 to 1

    @property
    def error(self) -> float:
        """What is shown less what is true; above 0 where a run seems farther than it is."""
        return self.shown - self.over


def moments(records: Sequence[Stored]) -> list[Moment]:
    """A run at each of its records from its begin on. Raises InputError if it has not ended well."""
    ended = replay(records)
    whole = elapsed(ended, records[-1].time) if records else None
    if ended.outcome != "done" or not whole:
        raise InputError("the run has not ended well; give one that is done")
    found, state = [], RunState()
    for stored in records:
        state = apply(state, [stored])
        seconds = elapsed(state, stored.time)
        if seconds is not None and state.outcome is None:
            found.append(Moment(seconds, min(1.0, seconds / whole), progress_of(state, stored.time)))
    return found


def followed(root: Path) -> list[Moment]:
    """A run from now until its end, as the page shows it. Raises InputError if it does not end well."""
    folder, shown, state = RunFolder(root), list[tuple[float, float]](), RunState()
    while state.outcome is None:
        time.sleep(_LOOK_S)
        if folder.database.exists():
            state = replay(list(history(root)))
            made = view_preparation(folder, state, running=True)
            summary = summarize(state, running=True, prepared=made.over if made else None)
            shown += [(summary.seconds, summary.progress)] if summary.seconds else []
    if state.outcome != "done":
        raise InputError("the run has not ended well")
    return [Moment(seconds, seconds / shown[-1][0], progress) for seconds, progress in shown[:-1]]


def worst(found: Sequence[Moment]) -> Moment | None:
    """The moment with the largest error once `SETTLED_S` are over; None of a shorter run."""
    return max((it for it in found if it.seconds > SETTLED_S), key=lambda it: abs(it.error), default=None)


def picture(runs: dict[str, list[Moment]]) -> str:
    """SVG: the progress of each run over its time, with the goal's band."""

    def draw(axes: Axes) -> None:
        axes.fill_between(
            [0, 100], [-100 * GOAL, 100 - 100 * GOAL], [100 * GOAL, 100 + 100 * GOAL], alpha=0.12
        )
        for number, (name, found) in enumerate(runs.items()):
            settled = [it for it in found if it.seconds > SETTLED_S]
            color = BLOCK_COLORS[number % len(BLOCK_COLORS)]
            over, shown = [100 * it.over for it in settled], [100 * it.shown for it in settled]
            axes.plot(over, shown, color=color, lw=1.4, label=name)
        axes.set_xlim(0, 100)
        axes.set_ylim(0, 100)
        axes.set_xlabel("time that is over, %")
        axes.set_ylabel("progress that is shown, %")

    return svg(draw, "Progress against time")


def main(arguments: Sequence[str] | None = None) -> int:
    """The program; returns its exit code."""
    parser = report.parser("progress", __doc__, quick=False)
    parser.add_argument("runs", type=Path, nargs="+", metavar="RUN", help="folder of a finished run")
    parser.add_argument("--follow", action="store_true", help="of runs that begin now, one after another")
    parser.add_argument("--svg", type=Path, metavar="FILE", help="draw the progress of all runs here")
    options = parser.parse_args(arguments)

    def work() -> report.Report:
        runs: dict[str, list[Moment]] = {}
        for root in options.runs:
            try:
                runs[str(root)] = followed(root) if options.follow else moments(list(history(root)))
            except InputError as error:
                raise InputError(f"{root}: {error}") from error
        if options.svg:
            write_bytes(options.svg, standalone(picture(runs)).encode())
        found = {name: worst(of_run) for name, of_run in runs.items()}
        rows = [
            (
                name,
                runs[name][-1].seconds,
                *((at.seconds, 100 * at.over, 100 * at.shown) if at else ("–",) * 3),
            )
            for name, at in found.items()
        ]
        head = ("run", "seconds", "worst at", "time over %", "shown %")
        met = all(at is None or abs(at.error) <= GOAL for at in found.values())
        content = {
            name: None if at is None else [at.seconds, at.over, at.shown] for name, at in found.items()
        }
        return report.Report({"worst": content}, report.markdown(head, rows), met)

    return report.run("progress", options, work)


if __name__ == "__main__":
    sys.exit(main())
