"""What the driver, Ray and checkpoints cost: Stage II of a run beside the same training in plain processes.

    python -m benchmarks.overhead [--iterations 6000] [--folder FOLDER] [--json]
    python -m benchmarks.overhead --quick

The blocks of a small town are trained three times on this machine: by `panolog resume`, in plain processes
that know neither Ray nor checkpoints, and by `panolog resume` again. The same blocks run side by side each
time, with as many threads, and must have the same bytes as their result. Every turn includes the start of its
processes. What the first turn and the last differ by is how well this machine can measure.
"""

import argparse
import hashlib
import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import asdict, astuple, dataclass
from pathlib import Path
from statistics import fmean

from benchmarks.report import machine
from benchmarks.runs import borrow_stage_one, history, panolog
from benchmarks.table import markdown
from panolog.orchestrator.run.folder import RunFolder
from panolog.orchestrator.run.records import CheckpointSaved, ModelSaved, PlanSaved, TaskStarted
from panolog.scene.errors import PanologError, RunError
from panolog.synthetic.make import make_town
from panolog.workers.training.config import CheckpointConfig

HEAD = ("turn", "seconds", "of training alone", "checkpoints")
BLOCKS = "2x1x1"
SHORT = 200  # iterations of Stage I, which is not measured


@dataclass(frozen=True)
class Size:
    """What is trained."""

    panoramas: int
    width: int  # pixels
    iterations: int  # of each block
    checkpoint: int  # iterations between two checkpoints


QUICK = Size(panoramas=9, width=64, iterations=60, checkpoint=20)


@dataclass(frozen=True)
class Turn:
    """All blocks trained once, side by side."""

    name: str
    seconds: float  # wall clock from the start of the first process to the last result
    training: float  # what the longest block says that its training took
    checkpoints: int
    digests: dict[str, str]  # of the result of each block


@dataclass(frozen=True)
class Report:
    """The three turns."""

    turns: tuple[Turn, Turn, Turn]

    @property
    def cost(self) -> float:
        """Of the driver, Ray and checkpoints, as a fraction of the wall clock without them."""
        first, plain, second = self.turns
        return fmean((first.seconds, second.seconds)) / plain.seconds - 1

    @property
    def noise(self) -> float:
        """By what fraction the two runs differ."""
        first, _, second = self.turns
        return abs(first.seconds / second.seconds - 1)


def measure(folder: Path, size: Size) -> Report:
    """Takes the three turns in `folder`. Raises RunError if a run fails or the results differ."""
    scene = make_town(folder / "town", panoramas=size.panoramas, width=size.width)
    stage_one = folder / "stage-one"
    short = ["--iterations", str(min(SHORT, size.iterations)), "--blocks", BLOCKS, "--device", "cpu"]
    short += ["--set", "sky.count=5000"]
    panolog("run", str(scene), "-o", str(stage_one), *short)
    first = _run(stage_one, folder / "run-1", size)
    plain = _plain(folder / "run-1")
    second = _run(stage_one, folder / "run-2", size)
    if not first.digests == plain.digests == second.digests:
        raise RunError("the turns did not do the same work: their results differ")
    return Report((first, plain, second))


def _run(stage_one: Path, root: Path, size: Size) -> Turn:
    settings = {"iterations": size.iterations, "checkpoint.every": size.checkpoint}
    borrow_stage_one(stage_one, root, settings)
    panolog("resume", str(root))
    return stage_two(root)


def stage_two(root: Path) -> Turn:
    """The blocks of a finished run."""
    records = history(root)
    began = next(stored.time for stored in records if isinstance(stored.record, PlanSaved))
    models = [(stored.time, stored.record) for stored in records if isinstance(stored.record, ModelSaved)]
    blocks = [(when, record) for when, record in models if record.task.startswith("block/")]
    files = {record.task: RunFolder(root).model(record.task) for _, record in blocks}
    return Turn(
        "run",
        max(when for when, _ in blocks) - began,
        max(record.seconds for _, record in blocks),
        sum(isinstance(stored.record, CheckpointSaved) for stored in records),
        {task: hashlib.sha256(path.read_bytes()).hexdigest() for task, path in files.items()},
    )


def _plain(root: Path) -> Turn:
    """The blocks of a finished run again, each in a process of its own. Raises RunError if one fails."""
    started = [stored.record for stored in history(root) if isinstance(stored.record, TaskStarted)]
    threads = {record.task: record.threads for record in started if record.task.startswith("block/")}
    began = time.perf_counter()
    processes = {}
    for task, count in sorted(threads.items()):
        print("$ plain", task, file=sys.stderr, flush=True)
        command = [sys.executable, "-m", "benchmarks.plain_training", str(root), task, str(count)]
        processes[task] = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    results = {}
    for task, process in processes.items():
        said, _ = process.communicate()
        if process.returncode:
            raise RunError(f"{task} failed in a plain process")
        results[task] = json.loads(said)
    seconds = time.perf_counter() - began
    training = max(result["seconds"] for result in results.values())
    return Turn("plain", seconds, training, 0, {task: result["digest"] for task, result in results.items()})


def parse(arguments: Sequence[str] | None = None) -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.overhead", description=__doc__.splitlines()[0]
    )
    parser.add_argument("--iterations", type=int, default=6000, help="of each block: 5 minutes or more")
    parser.add_argument(
        "--checkpoint", type=int, default=CheckpointConfig().every, help="iterations between two checkpoints"
    )
    parser.add_argument("--folder", type=Path, help="on the disk to write to; by default that of TMPDIR")
    parser.add_argument("--quick", action="store_true", help="small: to see that it works")
    parser.add_argument("--json", action="store_true", help="one JSON object on stdout")
    return parser.parse_args(arguments)


def main() -> int:
    """The program; returns its exit code."""
    options = parse()
    size = Size(28, 512, options.iterations, options.checkpoint)
    if options.quick:
        size = QUICK
    try:
        with tempfile.TemporaryDirectory(prefix="overhead-", dir=options.folder) as folder:
            report = measure(Path(folder), size)
    except PanologError as error:
        print(f"overhead: {error}", file=sys.stderr)
        return 1
    if options.json:
        content = {"machine": machine(), "size": asdict(size), **asdict(report)}
        print(json.dumps(content | {"cost": report.cost, "noise": report.noise}, indent=2))
    else:
        print(markdown(HEAD, [astuple(turn)[:-1] for turn in report.turns]))
        print(f"\ncost {report.cost:.1%} of the wall clock; the two runs differ by {report.noise:.1%}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
