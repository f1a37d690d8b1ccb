"""All that goes wrong in a long run: does every run end by itself, with the same bytes?

    python -m benchmarks.chaos [--runs 30] [--faults all] [--seed 0] [--folder FOLDER] [--json]
    python -m benchmarks.chaos --quick

A small town with four blocks is reconstructed on a Ray cluster of two nodes on this machine: once
undisturbed, then repeatedly with one or two faults at random times (`faults.Kind`). Drivers run under
`panolog run --supervise`, nodes that end are started again, as by a service manager. Every run must end
with the bytes of the undisturbed one, within twice its time and what `faults.LIMITS` allows for each fault.
"""

import argparse
import signal
import sys
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from benchmarks import report
from benchmarks.chaos.cluster import two_nodes
from benchmarks.chaos.faults import Kind, plans
from benchmarks.chaos.runs import ChaosRuns, Run
from panolog.scene.errors import RunError

HEAD = ("run", "faults", "run took s", "allowed s", "bytes")
_FAULTS = f"all, kill, {', '.join(Kind)}"
KILLS = (Kind.DRIVER, Kind.WORKER, Kind.RAYLET)
SLOWER = 2.0  # times the undisturbed run: half of the cluster may be in quarantine, and the machine is shared


@dataclass(frozen=True)
class Outcome:
    """All runs, and how long each of them may take."""

    runs: tuple[Run, ...]  # the undisturbed one first

    @property
    def undisturbed(self) -> Run:
        """The undisturbed run."""
        return self.runs[0]

    def allowed(self, run: Run) -> float:
        """Seconds that a run may take."""
        return SLOWER * self.undisturbed.seconds + sum(fault.planned.allowed for fault in run.faults)

    def failures(self) -> list[str]:
        """One line for each run with other bytes, and for each that took too long."""
        lines = []
        for run in self.runs[1:]:
            if run.digest != self.undisturbed.digest:
                lines.append(f"run {run.number}: {run.end or 'other bytes'}")
            if run.seconds > self.allowed(run):
                lines.append(f"run {run.number}: took {run.seconds:.1f} s of {self.allowed(run):.1f} s")
        return lines

    def rows(self) -> Iterator[tuple[object, ...]]:
        """One for each disturbed run, in the order of HEAD."""
        for run in self.runs[1:]:
            same = "failed" if run.end else "same" if run.digest == self.undisturbed.digest else "OTHER"
            what = ", ".join(f"{fault.planned.what} at {fault.at:.1f} s" for fault in run.faults)
            yield run.number, what, run.seconds, self.allowed(run), same


def chaos(root: Path, runs: int, seed: int, kinds: Sequence[Kind]) -> Outcome:
    """All runs, in the folder `root`. Raises RunError if the cluster or the undisturbed run fails."""
    root.mkdir(parents=True, exist_ok=True)
    with two_nodes() as cluster:
        town = ChaosRuns(cluster, root)
        done = [town.run(0, [])]
        if not done[0].digest:
            raise RunError(f"the undisturbed run failed: {done[0].end}")
        for number, plan in enumerate(plans(runs, seed, done[0].seconds, kinds), 1):
            done.append(town.disturbed(number, plan))
            print(_line(done[-1], runs), file=sys.stderr, flush=True)
        return Outcome(tuple(done))


def _line(run: Run, runs: int) -> str:
    """The progress of the benchmark."""
    causes = ", ".join(fault.planned.what for fault in run.faults)
    return f"run {run.number} of {runs}: {causes}: {run.end or f'{run.seconds:.0f} s'}"


def kinds_of(text: str) -> tuple[Kind, ...]:
    """The value of --faults. Raises ArgumentTypeError."""
    sets = {"all": tuple(Kind), "kill": KILLS}
    try:
        return tuple(kind for name in text.split(",") for kind in sets.get(name) or (Kind(name),))
    except ValueError as error:
        raise argparse.ArgumentTypeError(f"{error}; the kinds are {_FAULTS}") from error


def main(arguments: Sequence[str] | None = None) -> int:
    """The program; returns its exit code: 1 if a run did not end as it should, or lost too much time."""
    parser = report.parser("chaos", __doc__)
    parser.add_argument("--runs", type=int, default=30)
    parser.add_argument("--seed", type=int, default=0, help="of faults and times")
    parser.add_argument("--faults", type=kinds_of, default=tuple(Kind), metavar="KIND,...", help=_FAULTS)
    parser.add_argument("--folder", type=Path, help="an empty one, which keeps the runs")
    options = parser.parse_args(arguments)
    if options.quick:
        options.runs = 2
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))  # so that all contexts end

    def work() -> report.Report:
        with tempfile.TemporaryDirectory(prefix="chaos-runs-") as folder:
            outcome = chaos(options.folder or Path(folder), options.runs, options.seed, options.faults)
        failures = outcome.failures()
        parts = [
            f"undisturbed {outcome.undisturbed.seconds:.1f} s",
            report.markdown(HEAD, list(outcome.rows())),
            "\n".join(failures) or "all runs passed",
        ]
        content = {**asdict(outcome), "wrong": failures}
        return report.Report(content, "\n\n".join(parts), passed=not failures)

    return report.run("chaos", options, work)


if __name__ == "__main__":
    sys.exit(main())
