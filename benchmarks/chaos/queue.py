"""A queue of real runs whose processes are killed, and whose machine seems to start anew: order and results.

    python -m benchmarks.chaos.queue [--runs 50] [--at-once 1] [--kills 25] [--seed 0] [--folder FOLDER]
    python -m benchmarks.chaos.queue --quick

Runs of a small town are queued. At random times, spread over the runs, the runner, a supervisor, a driver or
everything at once is killed with SIGKILL, in turn; after "everything" the machine has another boot id. The
next runner starts at once. Every run must be done, begun in the order of the queue, with the bytes of the
first. With N at once, those that begin together may do so in either order: each is less than N places from
its own.
"""

import hashlib
import random
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from contextlib import closing, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import psutil

from benchmarks import report
from panolog.orchestrator.queue.entries import Command, State
from panolog.orchestrator.queue.store import Queue
from panolog.orchestrator.run.folder import RunFolder
from panolog.orchestrator.run.records import RunBegan
from panolog.orchestrator.run.store import read_records
from panolog.synthetic.make import make_town

_RUNNER = """
import sys
from pathlib import Path
from panolog.orchestrator.queue.processes import Processes
from panolog.orchestrator.queue.runner import Limits, run_queue, sole_runner
from panolog.orchestrator.queue.store import opened

folder, boot, at_once = Path(sys.argv[1]), Path(sys.argv[2]), int(sys.argv[3])
with opened(folder) as queue, sole_runner(folder):
    limits = Limits(at_once, processes=Processes(boot))
    sys.exit(run_queue(queue, limits, lambda line: print(line, flush=True)))
"""
_SETTINGS = (
    *("--blocks", "1", "--iterations", "60", "--width", "64", "--device", "cpu"),
    *("--set", "sky.count=100", "--set", "checkpoint.every=10", "--set", "checkpoint.share=1"),
    *("--set", "refine=false", "--set", "deliver=false"),
)
_KINDS = ("runner", "driver", "supervisor", "everything")
_FIRST_S, _LAST_S = 2.0, 25.0  # after a kill is due; a run takes some 15 s
_AHEAD = 2  # kills that may come before their part of the runs is done
_POLL_S = 0.5  # between two looks at whether the next kill is due
_MOST_RECORDS = 100_000


@dataclass
class Queued:
    """The runs and what is done to them."""

    root: Path
    at_once: int
    chance: random.Random
    kills: list[str] = field(default_factory=list)

    def add(self, runs: int) -> None:
        """Makes the town and queues its runs."""
        scene = make_town(self.root / "town", panoramas=9, width=64, points=300)
        with closing(Queue(self.root / "queue")) as queue:
            for number in range(runs):
                run = self.root / f"run-{number:03d}"
                queue.add(Command(run, (str(scene), "--output", str(run), *_SETTINGS), (), self.root))

    def work_off(self, kills: int) -> int:
        """Starts runners until one ends by itself; returns its exit code."""
        while True:
            boot = self.root / "boot_id"
            boot.write_text(f"boot-{self.kills.count('everything')}\n")
            command = [sys.executable, "-c", _RUNNER, str(self.root / "queue"), str(boot), str(self.at_once)]
            runner = subprocess.Popen(command, stdout=sys.stderr, start_new_session=True)
            while len(self.kills) < kills and runner.poll() is None:
                due = self._due(kills)
                with suppress(subprocess.TimeoutExpired):
                    runner.wait(self.chance.uniform(_FIRST_S, _LAST_S) if due else _POLL_S)
                if due and runner.poll() is None and self._kill(runner.pid) in ("runner", "everything"):
                    break
            code = runner.wait()
            if code >= 0:
                return code

    def _due(self, kills: int) -> bool:
        """Whether as large a part of the runs is done as of the kills, but for the last few."""
        with closing(Queue(self.root / "queue")) as queue:
            entries = queue.entries()
        done = sum(entry.state == State.DONE for entry in entries)
        return done * kills >= (len(self.kills) - _AHEAD) * len(entries)

    def _kill(self, runner: int) -> str:
        """Kills what is next in turn; returns what that was."""
        kind = _KINDS[len(self.kills) % len(_KINDS)]
        with suppress(psutil.NoSuchProcess):
            below = psutil.Process(runner).children(recursive=True)
            supervisors = psutil.Process(runner).children()
            drivers = [
                it for one in supervisors for it in one.children() if "panolog" in " ".join(it.cmdline())
            ]
            chosen = {
                "runner": [],
                "driver": drivers[:1],
                "supervisor": supervisors[:1],
                "everything": below,
            }[kind]
            if kind in ("runner", "everything"):
                psutil.Process(runner).kill()
            for process in chosen:
                with suppress(psutil.NoSuchProcess):
                    process.kill()
        self.kills.append(kind)
        print(f"killed: {kind}", file=sys.stderr, flush=True)
        return kind

    def wrong(self) -> list[str]:
        """One line for each run that is not as it should be."""
        lines, begun, digests = list[str](), list[tuple[float, int]](), dict[str, int]()
        with closing(Queue(self.root / "queue")) as queue:
            entries = queue.entries()
        for entry in entries:
            if entry.state != State.DONE:
                lines.append(f"entry {entry.id} is {entry.state}: {entry.reason}")
                continue
            folder = RunFolder(entry.command.run)
            records = read_records(folder.database, limit=_MOST_RECORDS)
            begun.append((next(it.time for it in records if isinstance(it.record, RunBegan)), entry.id))
            digests.setdefault(hashlib.sha256(folder.point_cloud.read_bytes()).hexdigest(), entry.id)
        order = [id for _, id in sorted(begun)]
        if any(abs(place - order.index(id)) >= self.at_once for place, id in enumerate(sorted(order))):
            lines.append(f"they began in another order: {order}")
        lines += [f"entry {id} has other bytes than the first" for id in list(digests.values())[1:]]
        return lines

    def drivers(self) -> int:
        """How many there were."""
        runs = sorted(self.root.glob("run-*"))
        records = (read_records(RunFolder(run).database, limit=_MOST_RECORDS) for run in runs)
        return sum(isinstance(it.record, RunBegan) for one in records for it in one)


def queue_chaos(root: Path, options: Any) -> dict[str, Any]:
    """All of it, in the folder `root`: numbers, and what went wrong."""
    began = time.monotonic()
    queued = Queued(root.resolve(), options.at_once, random.Random(options.seed))
    queued.add(options.runs)
    code = queued.work_off(options.kills)
    wrong = queued.wrong() + ([f"the last runner ended with {code}"] if code else [])
    kills = {kind: queued.kills.count(kind) for kind in _KINDS}
    seconds = time.monotonic() - began
    return {
        "runs": options.runs,
        "kills": kills,
        "drivers": queued.drivers(),
        "seconds": seconds,
        "wrong": wrong,
    }


def main(arguments: Sequence[str] | None = None) -> int:
    """The program; returns its exit code: 1 if a run is not as it should be."""
    parser = report.parser("chaos.queue", __doc__)
    parser.add_argument("--runs", type=int, default=50)
    parser.add_argument("--at-once", type=int, default=1)
    parser.add_argument("--kills", type=int, default=25)
    parser.add_argument("--seed", type=int, default=0, help="of the times")
    parser.add_argument("--folder", type=Path, help="an empty one, which keeps the runs")
    options = parser.parse_args(arguments)
    if options.quick:
        options.runs, options.kills = 3, 4

    def work() -> report.Report:
        with tempfile.TemporaryDirectory(prefix="chaos-queue-") as folder:
            content = queue_chaos(options.folder or Path(folder), options)
        row = (content["runs"], *content["kills"].values(), content["drivers"], content["seconds"])
        head = ("runs", *(f"{kind} killed" for kind in _KINDS), "drivers", "s")
        text = report.markdown(head, [row]) + "\n\n" + ("\n".join(content["wrong"]) or "all runs are right")
        return report.Report(content, text, passed=not content["wrong"])

    return report.run("chaos-queue", options, work)


if __name__ == "__main__":
    sys.exit(main())
