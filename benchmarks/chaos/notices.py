"""Nodes that announce that they leave: does every run end with the same bytes, and what does it lose?

    python -m benchmarks.chaos.notices [--runs 20] [--seconds 120,30,0] [--nodes 2,3] [--seed 0]
    python -m benchmarks.chaos.notices --quick

A small town with two blocks is reconstructed on Ray clusters of two and of three nodes on this machine, whose
head runs no tasks: once undisturbed on each, then repeatedly while a node leaves on which a task trains, as
spot machines of Amazon do, with 120, 30 or 0 seconds of notice. On two nodes Stage I is hit, on three a
block, so that a node is free for the task that moves. What has left is started again, as by an autoscaler.
With a notice nothing may be trained twice, and a task may lose the time of its last checkpoint and 5 s.
"""

import argparse
import hashlib
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from random import Random

import psutil

from benchmarks import report
from benchmarks.chaos.cable import laid
from benchmarks.chaos.cluster import DRIVER, FOURTH, HEAD, SECOND, THIRD, LocalCluster, started
from benchmarks.chaos.notice_costs import LIMIT_S, NoticeCost, notice_cost
from benchmarks.runs import BIN, history
from panolog.orchestrator.resources.metadata import VARIABLE
from panolog.orchestrator.run.folder import RunFolder
from panolog.orchestrator.run.records import Progressed, TaskStarted
from panolog.scene.errors import RunFolderError
from panolog.synthetic.make import make_town
from panolog.workers.tasks import Stage
from tests.metadata_service import Metadata, metadata

HEADER = (
    *("run", "nodes", "notice s", "task", "noticed after s", "checkpoint s", "started elsewhere after s"),
    *("iterations redone", "lost s", "bytes"),
)
SETTINGS = (
    *("--blocks", "2x1x1", "--width", "128", "--device", "cpu"),
    *("--set", "sky.count=500", "--set", "checkpoint.every=50", "--set", "checkpoint.share=1"),
)
ITERATIONS = 1500  # so many that a task is still training when its node leaves
_HIT = {2: Stage.COARSE, 3: Stage.BLOCK}  # the stage in which a node leaves, by the number of nodes
_TIMEOUT_S = 300.0  # for a run
_POLL_S = 0.05  # between two looks at the run


@dataclass(frozen=True)
class Planned:
    """A node that leaves."""

    seconds: float  # of notice
    share: float  # of its iterations that a task has done when its node gets the notice


@dataclass(frozen=True)
class Run:
    """One run."""

    number: int  # 0 is the undisturbed one
    nodes: int
    digest: str  # of the PLY; empty if the run failed
    end: str  # error of the run; empty if it did not fail
    seconds: float | None = None  # of notice
    cost: NoticeCost | None = None


@dataclass(frozen=True)
class Outcome:
    """All runs, those of two nodes first, each cluster's undisturbed one before its others."""

    runs: tuple[Run, ...]

    def failures(self) -> list[str]:
        """One line for each run with other bytes, and for each task that has lost too much."""
        lines, digests = [], {run.nodes: run.digest for run in self.runs if not run.number}
        for run in self.runs:
            name = f"run {run.number} on {run.nodes} nodes"
            if not run.digest or run.digest != digests[run.nodes]:
                lines.append(f"{name}: {run.end or 'other bytes'}")
            if run.number and run.cost is None:
                lines.append(f"{name}: the node that left had no task")
            elif run.cost is not None and run.seconds:
                lines += [f"{name}: {why}" for why in run.cost.too_much()]
        return lines

    def rows(self) -> Iterator[tuple[object, ...]]:
        """One for each run that was disturbed, in the order of HEADER."""
        digests = {run.nodes: run.digest for run in self.runs if not run.number}
        for run in self.runs:
            if run.cost is not None:
                cost, same = run.cost, "same" if run.digest == digests[run.nodes] else "OTHER"
                times = (cost.noticed, cost.checkpoint, cost.elsewhere, cost.redone, cost.lost)
                yield (run.number, run.nodes, f"{run.seconds:g}", str(cost.task), *times, same)


class Spots:
    """Runs of one scene on one cluster, whose nodes but the head may leave."""

    def __init__(
        self, cluster: LocalCluster, services: dict[str, Metadata], root: Path, scene: Path, iterations: int
    ) -> None:
        """Args: services, the metadata service of each node that may leave; root, a folder for the runs."""
        self._cluster, self._services = cluster, services
        self._root, self._scene, self._iterations = root, scene, iterations

    def run(self, number: int, planned: Planned | None) -> Run:
        """A whole run, of which a node leaves as planned."""
        nodes = len(self._services)
        folder = self._root / f"run-{number:03d}"
        self._cluster.wait()
        command = [str(BIN / "panolog"), "run", str(self._scene), "-o", str(folder), *SETTINGS]
        command += ["--iterations", str(self._iterations), "--address", self._cluster.address]
        with (self._root / f"{folder.name}.log").open("wb") as log:
            environment = self._cluster.environment(DRIVER)
            driver = subprocess.Popen(command, env=environment, stdout=log, stderr=log)
            left = self._watch(driver, folder, planned)
        if driver.returncode:
            lines = (self._root / f"{folder.name}.log").read_text().strip().splitlines()
            end = f"exit code {driver.returncode}: {lines[-1] if lines else 'no output'}"
            return Run(number, nodes, "", end, planned.seconds if planned else None)
        digest = hashlib.sha256(RunFolder(folder).point_cloud.read_bytes()).hexdigest()
        cost = notice_cost(history(folder), *left) if left else None
        return Run(number, nodes, digest, "", planned.seconds if planned else None, cost)

    def _watch(
        self, driver: subprocess.Popen[bytes], folder: Path, planned: Planned | None
    ) -> tuple[str, float] | None:
        """Until the run has ended. Returns the Node.id of the node that left, and when it learned that."""
        left: tuple[str, float] | None = None
        name, due, end = "", float("inf"), time.monotonic() + _TIMEOUT_S
        while time.monotonic() < end:
            with suppress(subprocess.TimeoutExpired):
                driver.wait(_POLL_S)
                break
            if planned and not left and (name := self._victim(folder, planned.share)):
                left = self._cluster.node_id(name), time.time()
                self._services[name].spot(planned.seconds)
                due = time.monotonic() + planned.seconds
            if time.monotonic() >= due:
                self._take(name)
                due = float("inf")
            self._cluster.keep()
        else:
            driver.kill()
            driver.wait()
        if due < float("inf"):
            self._take(name)
        return left

    def _take(self, name: str) -> None:
        """The node is gone; the next one of its kind has no notice."""
        if (raylet := self._cluster.raylet(name)) is not None:
            with suppress(psutil.NoSuchProcess):
                raylet.kill()
                raylet.wait()
        self._services[name].values.clear()

    def _victim(self, folder: Path, share: float) -> str:
        """A node whose task has done such a share of its iterations; "" if there is none yet."""
        try:
            records = [stored.record for stored in history(folder)]
        except RunFolderError:
            return ""  # the run has not begun
        where = {record.task: record.node_id for record in records if isinstance(record, TaskStarted)}
        for record in records:
            hit = isinstance(record, Progressed) and record.task.stage is _HIT[len(self._services)]
            if hit and isinstance(record, Progressed) and record.iteration >= share * record.iterations:
                ids = {self._cluster.node_id(name): name for name in self._services}
                return ids.get(where.get(record.task, ""), "")
        return ""


def plans(runs: int, seed: int, seconds: Sequence[float]) -> Iterator[Planned]:
    """For each run when a node leaves; all lengths of notice come equally often."""
    random = Random(seed)
    for number in range(runs):
        yield Planned(seconds[number % len(seconds)], random.uniform(0.1, 0.7))


def notices(
    root: Path, plan: Sequence[Planned], sizes: Sequence[int] = (2, 3), iterations: int = ITERATIONS
) -> Outcome:
    """All runs, in the folder `root`: as planned, in turn on clusters of so many nodes; iterations of a task.

    Raises RunError if a cluster does not start.
    """
    done: list[Run] = []
    scene = make_town(root / "town", panoramas=12, width=128, points=1000)
    for index, size in enumerate(sizes):
        folder = root / f"nodes-{size}"
        folder.mkdir()
        with ExitStack() as stack:
            cable = stack.enter_context(laid(folder))
            names = (SECOND, THIRD, FOURTH)[:size]
            hosts = {name: cable.near if cable and name == SECOND else "127.0.0.1" for name in names}
            services = {name: stack.enter_context(metadata("amazon", host)) for name, host in hosts.items()}
            variables = {name: {VARIABLE: service.url} for name, service in services.items()}
            cores = {HEAD: 0} | dict.fromkeys(names, 1)
            cluster = stack.enter_context(started(cable, cores, variables))
            spots = Spots(cluster, services, folder, scene, iterations)
            mine = [None, *plan[index :: len(sizes)]]
            for number, planned in enumerate(mine):
                done.append(spots.run(number, planned))
                print(_line(done[-1]), file=sys.stderr, flush=True)
    return Outcome(tuple(done))


def _line(run: Run) -> str:
    """The progress of the benchmark."""
    what = "undisturbed" if run.cost is None else f"{run.seconds:g} s of notice, {run.cost.lost:.1f} s lost"
    return f"{run.nodes} nodes, run {run.number}: {run.end or what}"


def main(arguments: Sequence[str] | None = None) -> int:
    """The program; returns its exit code: 1 if a run did not end as it should, or lost too much time."""
    parser = report.parser("notices", __doc__)
    parser.add_argument("--runs", type=int, default=20)
    parser.add_argument("--seed", type=int, default=0, help="of the times")
    parser.add_argument("--seconds", type=seconds_of, default=(120.0, 30.0, 0.0), help="of notice: S,S,...")
    parser.add_argument("--nodes", type=sizes_of, default=(2, 3), help="of the clusters: 2, 3 or 2,3")
    parser.add_argument("--folder", type=Path, help="an empty one, which keeps the runs")
    options = parser.parse_args(arguments)
    if options.quick:
        options.runs = 2

    def work() -> report.Report:
        with tempfile.TemporaryDirectory(prefix="chaos-notices-") as folder:
            plan = list(plans(options.runs, options.seed, options.seconds))
            outcome = notices(options.folder or Path(folder), plan, options.nodes)
        failures = outcome.failures()
        last = "\n".join(failures) or f"all runs passed; the limit is a checkpoint and {LIMIT_S:g} s"
        text = f"{report.markdown(HEADER, list(outcome.rows()))}\n\n{last}"
        return report.Report({**asdict(outcome), "wrong": failures}, text, passed=not failures)

    return report.run("notices", options, work)


def seconds_of(text: str) -> tuple[float, ...]:
    """The value of --seconds. Raises ArgumentTypeError."""
    try:
        return tuple(map(float, text.split(",")))
    except ValueError as error:
        raise argparse.ArgumentTypeError(f"{text}: write seconds, such as 120,30,0") from error


def sizes_of(text: str) -> tuple[int, ...]:
    """The value of --nodes. Raises ArgumentTypeError."""
    sizes = tuple(size for size in _HIT if str(size) in text.split(","))
    if len(sizes) != len(text.split(",")):
        raise argparse.ArgumentTypeError(f"{text}: write 2, 3 or 2,3")
    return sizes


if __name__ == "__main__":
    sys.exit(main())
