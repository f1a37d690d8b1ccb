"""Random SIGKILLs for the driver, Ray's workers and a whole node: does every run end with the same bytes?

    python -m benchmarks.chaos [--runs 30] [--seed 0] [--folder FOLDER] [--json]
    python -m benchmarks.chaos --quick

A small town with four blocks is reconstructed on a Ray cluster of two nodes on this machine: once
undisturbed, then repeatedly with one to three kills at random times. A killed driver is followed by
`panolog resume`, a killed raylet by a new node, as under a supervisor. Every run must end with the
bytes of the undisturbed one, and each kill may cost one checkpoint interval and ten seconds.
"""

import hashlib
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from random import Random
from shutil import rmtree

from benchmarks import report
from benchmarks.chaos.cluster import TwoNodes, two_nodes
from benchmarks.chaos.kill_costs import Kill, KillCost, kill_costs, longest_unsaved
from benchmarks.runs import BIN, history
from panolog.orchestrator.run.folder import RunFolder
from panolog.scene.errors import RunError
from panolog.synthetic.make import make_town

VICTIMS = ("driver", "worker", "raylet")
ALLOWED = 10.0  # seconds that a kill may cost in addition to a checkpoint interval
SETTINGS = (
    *("--blocks", "2x2x1", "--iterations", "300", "--width", "128", "--device", "cpu"),
    *("--set", "sky.count=500", "--set", "checkpoint.every=50", "--set", "preview.every=100"),
)
HEAD = (
    *("run", "killed at s", "tasks ended", "redone s", "recovery s", "lost s"),
    *("allowed s", "run took s longer", "bytes"),
)
_TIMEOUT_S = 600.0  # for a run
_POLL_S = 0.05  # between two searches for a worker


@dataclass(frozen=True)
class PlannedKill:
    """A planned kill."""

    after: float  # seconds since the beginning of the run
    victim: str
    choice: float  # in [0, 1): which of several


@dataclass(frozen=True)
class Run:
    """One run and its kills."""

    number: int  # 0 is the undisturbed one
    began: float  # seconds since the epoch
    seconds: float  # from the first command to the end of the last
    kill_costs: tuple[KillCost, ...]
    digest: str  # of the PLY; empty if the run failed
    end: str  # error of the last command; empty if it did not fail


class ChaosRuns:
    """Runs of one scene on one cluster, in the folder `root`."""

    def __init__(self, cluster: TwoNodes, root: Path) -> None:
        self._cluster = cluster
        self._root = root
        self._scene = make_town(root / "town", panoramas=12, width=128, points=1000)

    def run(self, number: int, plan: Sequence[PlannedKill]) -> Run:
        """A whole run, with kills in the order of the plan."""
        folder, kills = self.folder(number), []
        self._cluster.wait_for_second()
        began = time.time()
        driver = self._launch(folder)
        for planned in plan:
            if not _still_runs(driver, until=began + planned.after):
                break
            if (kill := self._kill(planned, driver)) is None:
                break
            kills.append(kill)
            if planned.victim == "driver":
                driver = self._launch(folder)
        end, ended, paths = self._end(driver), time.time(), RunFolder(folder)
        digest = "" if end else hashlib.sha256(paths.point_cloud.read_bytes()).hexdigest()
        records = history(folder) if paths.database.exists() else []  # none if it failed at once
        return Run(number, began, ended - began, tuple(kill_costs(records, kills)), digest, end)

    def disturbed(self, number: int, plan: Sequence[PlannedKill]) -> Run:
        """A run with at least one kill: one that ended before the first is repeated with earlier kills."""
        while not (run := self.run(number, plan)).kill_costs and not run.end:
            rmtree(self.folder(number))
            plan = [replace(planned, after=planned.after / 2) for planned in plan]
        return run

    def folder(self, number: int) -> Path:
        """The folder of a run."""
        return self._root / f"run-{number:03d}"

    def _launch(self, folder: Path) -> subprocess.Popen[bytes]:
        """`panolog run`, or `panolog resume` where the folder holds a run already."""
        command = ["resume", str(folder)]
        if not RunFolder(folder).info.exists():
            command = ["run", str(self._scene), "-o", str(folder), *SETTINGS]
        command = [str(BIN / "panolog"), *command, "--address", self._cluster.address]
        with (self._root / "driver.log").open("ab") as log:
            return subprocess.Popen(command, env=self._cluster.environment, stdout=log, stderr=log)

    def _end(self, driver: subprocess.Popen[bytes]) -> str:
        """Waits for the driver; returns its error, empty if it ended well."""
        try:
            code = driver.wait(_TIMEOUT_S)
        except subprocess.TimeoutExpired:
            driver.kill()
            return f"no end after {_TIMEOUT_S:.0f} s"
        if not code:
            return ""
        return f"exit code {code}: {(self._root / 'driver.log').read_text().strip().splitlines()[-1]}"

    def _kill(self, planned: PlannedKill, driver: subprocess.Popen[bytes]) -> Kill | None:
        """None if the run has ended before there was a victim."""
        if planned.victim == "raylet":
            killed = self._cluster.kill_second()
            self._cluster.start_second()
        elif planned.victim == "driver":
            driver.kill()
            killed = time.time()
            driver.wait(_TIMEOUT_S)
        else:
            while not self._cluster.kill_worker(planned.choice):
                if not _still_runs(driver, until=time.time() + _POLL_S):
                    return None
            killed = time.time()
        return Kill(killed, planned.victim)


def _still_runs(driver: subprocess.Popen[bytes], until: float) -> bool:
    """Waits until then, or until the driver has ended: then it returns False."""
    try:
        driver.wait(max(0.0, until - time.time()))
    except subprocess.TimeoutExpired:
        return True
    return False


def plans(runs: int, seed: int, seconds: float) -> Iterator[list[PlannedKill]]:
    """For each run one to three kills, in order, within the time that an undisturbed run takes."""
    random = Random(seed)
    for _ in range(runs):
        times = sorted(random.uniform(0.05, 0.95) * seconds for _ in range(random.randint(1, 3)))
        yield [PlannedKill(after, random.choice(VICTIMS), random.random()) for after in times]


@dataclass(frozen=True)
class Outcome:
    """All runs, and what each kill may cost."""

    runs: tuple[Run, ...]  # the undisturbed one first
    interval: float  # seconds between two checkpoints of the undisturbed run, at most

    @property
    def undisturbed(self) -> Run:
        """The undisturbed run."""
        return self.runs[0]

    def allowed(self, cost: KillCost) -> float:
        """Seconds that those kills may cost."""
        return len(cost.kills) * (self.interval + ALLOWED)

    def failures(self) -> list[str]:
        """One line for each run with other bytes and each cost above the limit."""
        lines = []
        for run in self.runs[1:]:
            if run.digest != self.undisturbed.digest:
                lines.append(f"run {run.number}: {run.end or 'other bytes'}")
            for cost in run.kill_costs:
                if cost.seconds > self.allowed(cost):
                    lines.append(f"run {run.number}: lost {cost.seconds:.1f} s of {self.allowed(cost):.1f} s")
        return lines

    def rows(self) -> Iterator[tuple[object, ...]]:
        """One for each disturbance, in the order of HEAD."""
        for run in self.runs[1:]:
            same = "same" if run.digest == self.undisturbed.digest else run.end or "OTHER"
            for cost in run.kill_costs:
                killed = ", ".join(f"{kill.victim} {kill.time - run.began:.1f}" for kill in cost.kills)
                longer = run.seconds - self.undisturbed.seconds
                tasks = ", ".join(map(str, cost.tasks))
                costs = (cost.redone, cost.recovery, cost.seconds, self.allowed(cost), longer)
                yield (run.number, killed, tasks, *costs, same)


def chaos(root: Path, runs: int, seed: int) -> Outcome:
    """All runs, in the folder `root`. Raises RunError if the cluster or the undisturbed run fails."""
    with two_nodes() as cluster:
        town = ChaosRuns(cluster, root)
        done = [town.run(0, [])]
        if not done[0].digest:
            raise RunError(f"the undisturbed run failed: {done[0].end}")
        for number, plan in enumerate(plans(runs, seed, done[0].seconds), 1):
            done.append(town.disturbed(number, plan))
            print(f"run {number} of {runs}: {done[-1].seconds:.0f} s", file=sys.stderr, flush=True)
        return Outcome(tuple(done), longest_unsaved(history(town.folder(0))))


def main(arguments: Sequence[str] | None = None) -> int:
    """The program; returns its exit code: 1 if a run did not end as it should, or lost too much time."""
    parser = report.parser("chaos", __doc__)
    parser.add_argument("--runs", type=int, default=30)
    parser.add_argument("--seed", type=int, default=0, help="of victims and times")
    parser.add_argument("--folder", type=Path, help="an empty one, which keeps the runs")
    options = parser.parse_args(arguments)
    if options.quick:
        options.runs = 2

    def work() -> report.Report:
        with tempfile.TemporaryDirectory(prefix="chaos-runs-") as folder:
            outcome = chaos(options.folder or Path(folder), options.runs, options.seed)
        failures = outcome.failures()
        parts = [
            f"undisturbed {outcome.undisturbed.seconds:.1f} s, checkpoint interval {outcome.interval:.1f} s",
            report.markdown(HEAD, list(outcome.rows())),
            "\n".join(failures) or "all runs passed",
        ]
        content = {**asdict(outcome), "wrong": failures}
        return report.Report(content, "\n\n".join(parts), passed=not failures)

    return report.run("chaos", options, work)


if __name__ == "__main__":
    sys.exit(main())
