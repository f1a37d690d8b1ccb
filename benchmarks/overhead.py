"""What the driver, Ray and checkpoints cost: Stage II of a run against the same training in plain processes.

    python -m benchmarks.overhead [--iterations 6000] [--folder FOLDER] [--json]
    python -m benchmarks.overhead --quick

The blocks of a small town are trained three times on this machine: by `panolog resume`, in plain processes
without driver, Ray or checkpoints, and by `panolog resume` again. Each time the blocks run in parallel with
the same number of threads, and must give the same bytes. Every turn includes the start of its processes. The
difference between the first turn and the last is the noise of the measurement.
"""

import hashlib
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, astuple, dataclass
from pathlib import Path
from statistics import fmean

from benchmarks import report
from benchmarks.runs import borrow_stage_one, history, panolog
from panolog.orchestrator.driver.job import Job, Specs
from panolog.orchestrator.driver.local_pool import local_pool
from panolog.orchestrator.resources.nodes import Placement
from panolog.orchestrator.resources.pool import Ended, Failed, InProcess
from panolog.orchestrator.run.config import change
from panolog.orchestrator.run.folder import RunFolder
from panolog.orchestrator.run.info import read_info
from panolog.orchestrator.run.records import CheckpointSaved, ModelSaved, PlanSaved, TaskStarted
from panolog.orchestrator.stages.scenes import scene_of
from panolog.scene.errors import RunError
from panolog.scene.ply import write_ply
from panolog.synthetic.make import make_town
from panolog.workers.events import Trained
from panolog.workers.tasks import Stage, TaskId
from panolog.workers.training.config import CheckpointConfig

HEAD = ("turn", "seconds", "of training alone", "checkpoints")
BLOCKS = "2x1x1"
SHORT = 200  # iterations of Stage I, which is not measured
_NEVER = 10**9  # iterations
_POLL_S = 1.0  # longest wait for a message


@dataclass(frozen=True)
class TrainingSize:
    """What is trained."""

    panoramas: int
    width: int  # pixels
    iterations: int  # of each block
    checkpoint: int  # iterations between two checkpoints


QUICK = TrainingSize(panoramas=9, width=64, iterations=60, checkpoint=20)


@dataclass(frozen=True)
class Turn:
    """All blocks trained once, in parallel."""

    name: str
    seconds: float  # wall clock from the start of the first process to the last result
    training: float  # seconds that the longest block reports for its training
    checkpoints: int
    digests: dict[str, str]  # of the result of each block


@dataclass(frozen=True)
class Turns:
    """The three turns: run, plain processes, run."""

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


def measure(folder: Path, size: TrainingSize) -> Turns:
    """Measures the three turns in `folder`. Raises RunError if a run fails or the results differ."""
    scene = make_town(folder / "town", panoramas=size.panoramas, width=size.width)
    stage_one = folder / "stage-one"
    short = ["--iterations", str(min(SHORT, size.iterations)), "--blocks", BLOCKS, "--device", "cpu"]
    short += ["--set", "sky.count=5000"]
    panolog("run", str(scene), "-o", str(stage_one), *short)
    first = _run(stage_one, folder / "run-1", size)
    plain = _plain(RunFolder(folder / "run-1"), folder / "plain")
    second = _run(stage_one, folder / "run-2", size)
    if not first.digests == plain.digests == second.digests:
        raise RunError("the results of the turns differ")
    return Turns((first, plain, second))


def _run(stage_one: Path, root: Path, size: TrainingSize) -> Turn:
    """Stage II of a run that borrows Stage I."""
    settings = {"iterations": size.iterations, "checkpoint.every": size.checkpoint, "checkpoint.share": 1}
    borrow_stage_one(stage_one, root, settings)
    panolog("resume", str(root))
    records = history(root)
    began = next(stored.time for stored in records if isinstance(stored.record, PlanSaved))
    saved = [(stored.time, stored.record) for stored in records if isinstance(stored.record, ModelSaved)]
    blocks = [(when, record) for when, record in saved if record.task.stage is Stage.BLOCK]
    models = {record.task: RunFolder(root).model(record.task) for _, record in blocks}
    return Turn(
        "run",
        max(when for when, _ in blocks) - began,
        max(record.seconds for _, record in blocks),
        sum(isinstance(stored.record, CheckpointSaved) for stored in records),
        _digests(models),
    )


def _plain(run: RunFolder, folder: Path) -> Turn:
    """The blocks of a finished run again, each in a process, without driver, Ray or checkpoints."""
    folder.mkdir()
    info = read_info(run)
    job = Job(run, scene_of(info, run), change(info.config, {"checkpoint.every": _NEVER}))
    specs = Specs(job, InProcess())
    started = [stored.record for stored in history(run.root) if isinstance(stored.record, TaskStarted)]
    threads = {record.task: record.threads for record in started if record.task.stage is Stage.BLOCK}
    running, models, training = set(threads), {task: folder / f"{task.number}.ply" for task in threads}, []
    began = time.perf_counter()
    with local_pool() as pool:
        (node,) = pool.nodes()
        for task, cpus in threads.items():
            pool.start(Placement(node.id, cpus, node.memory), specs.of(task))
        while running:
            for task in pool.ready(_POLL_S):
                message = pool.take(task)
                if isinstance(message, Trained):
                    write_ply(models[task], message.gaussians)
                    training.append(message.seconds)
                elif isinstance(message, Failed):
                    raise RunError(f"{task}: {message.reason}")
                elif isinstance(message, Ended):
                    running.remove(task)
        seconds = time.perf_counter() - began
    return Turn("plain", seconds, max(training), 0, _digests(models))


def _digests(models: Mapping[TaskId, Path]) -> dict[str, str]:
    return {str(task): hashlib.sha256(path.read_bytes()).hexdigest() for task, path in models.items()}


def main(arguments: Sequence[str] | None = None) -> int:
    """The program; returns its exit code."""
    parser = report.parser("overhead", __doc__)
    parser.add_argument("--iterations", type=int, default=6000, help="of each block: 5 minutes or more")
    parser.add_argument(
        "--checkpoint", type=int, default=CheckpointConfig().every, help="iterations between two checkpoints"
    )
    parser.add_argument("--folder", type=Path, help="on the disk to write to; by default that of TMPDIR")
    options = parser.parse_args(arguments)
    size = QUICK if options.quick else TrainingSize(28, 512, options.iterations, options.checkpoint)

    def work() -> report.Report:
        with tempfile.TemporaryDirectory(prefix="overhead-", dir=options.folder) as folder:
            found = measure(Path(folder), size)
        table = report.markdown(HEAD, [astuple(turn)[:-1] for turn in found.turns])
        cost = f"cost {found.cost:.1%} of the wall clock; the two runs differ by {found.noise:.1%}"
        content = {"size": asdict(size), **asdict(found), "cost": found.cost, "noise": found.noise}
        return report.Report(content, f"{table}\n\n{cost}")

    return report.run("overhead", options, work)


if __name__ == "__main__":
    sys.exit(main())
