"""Runs as a benchmark needs them: started by the public command, read from their folders."""

import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import replace
from itertools import dropwhile, pairwise
from pathlib import Path
from shutil import copytree, rmtree
from typing import Any, cast

from panolog.orchestrator.engine.scheduling.pool import Pool
from panolog.orchestrator.runs.config import change
from panolog.orchestrator.runs.database import Database, read_records
from panolog.orchestrator.runs.folder import RunFolder
from panolog.orchestrator.runs.info import make_info, read_info, write_info
from panolog.orchestrator.runs.machines.machine import cores
from panolog.orchestrator.runs.machines.nodes import Node, Placement
from panolog.orchestrator.runs.records import (
    ModelSaved,
    Noticed,
    Part,
    RunBegan,
    ScoresSaved,
    Stored,
    TaskStarted,
    task_name,
)
from panolog.scene.errors import RunError
from panolog.workers.specs import TaskSpec
from panolog.workers.tasks import COARSE, Stage, TaskId

_BEFORE = (Stage.CALIBRATE, Part.PREFLIGHT)  # of the records of a preflight
BIN = Path(sys.executable).parent  # the programs of this environment


class OneAtATime:
    """A pool whose tasks on the CPU run one after another, each with all cores of the machine.

    Otherwise blocks that start together share the cores, while Stage I has all of them: the seconds of a
    block and those of Stage I would not compare. Tasks on GPUs are placed as ever; all else is the pool's.
    """

    def __init__(self, pool: Pool) -> None:
        self._pool = pool

    def __getattr__(self, name: str) -> Any:
        return getattr(self._pool, name)

    def nodes(self) -> tuple[Node, ...]:
        """Those without a GPU with one core, as the placement sees them."""
        return tuple(
            node if node.gpus else replace(node, cpus=min(node.cpus, 1)) for node in self._pool.nodes()
        )

    def start(self, placement: Placement, spec: TaskSpec) -> None:
        """Runs a spec with all cores, or on its GPU."""
        self._pool.start(placement if placement.gpus else replace(placement, cpus=float(cores())), spec)


@contextmanager
def one_at_a_time(root: Path) -> Iterator[Pool]:
    """Ray on this machine for one run, with tasks one at a time; fresh workers, so that peaks are its own."""
    from panolog.orchestrator.engine.cluster.connection import connect  # noqa: PLC0415  # other benchmarks do without

    with connect(None, root) as pool:
        yield cast(Pool, OneAtATime(pool))


def panolog(*arguments: str) -> str:
    """Runs the `panolog` of this environment and returns its stdout; its messages go to stderr.

    Raises RunError if its exit code is not 0. An interruption reaches it too, and its end is awaited.
    """
    command = [sys.executable, "-m", "panolog.orchestrator.cli", *arguments]
    print("$ panolog", *arguments, file=sys.stderr, flush=True)
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        try:
            stdout, _ = process.communicate()
        except KeyboardInterrupt:
            process.wait()
            raise
    if process.returncode:
        raise RunError(f"panolog {arguments[0]} ended with {process.returncode}")
    return stdout


def history(root: Path) -> list[Stored]:
    """All records of a run. Raises InputError if it has none."""
    database = RunFolder(root).database
    records: list[Stored] = []
    while more := read_records(database, after=records[-1].id if records else 0):
        records += more
    return records


def stage_seconds(records: Sequence[Stored], *, start: bool = True) -> dict[str, float]:
    """Wall-clock seconds by stage ("coarse", "score", "plan", "block", "merge", "eval", ..., "" for the end).

    The time between two records belongs to the stage of the later one, so that the stages add up to the run.
    Time without a driver does not count, neither before the first nor between two, nor that of the preflight.
    Args: start, whether the time of a driver before its first task counts: the start of its workers.
    """
    seconds: dict[str, float] = {}
    for _, stage, took in _steps(records, start):
        seconds[stage] = seconds.get(stage, 0.0) + took
    return seconds


def clock(records: Sequence[Stored], *, start: bool = True) -> dict[int, float]:
    """Seconds of `stage_seconds` that had passed at each record, by its id."""
    passed, found = 0.0, {}
    for item, _, took in _steps(records, start):
        passed += took
        found[item.id] = passed
    return found


def _steps(records: Sequence[Stored], start: bool) -> Iterator[tuple[Stored, str, float]]:
    """Each record that ends a time that counts, its stage, and the seconds since the record before."""
    attended = dropwhile(lambda item: not isinstance(item.record, RunBegan), records)
    working = start
    for before, after in pairwise(attended):
        if isinstance(after.record, RunBegan):
            working = start
        else:
            task = after.record.task
            stage = str(task.stage) if isinstance(task, TaskId) else task_name(after.record)
            if stage not in _BEFORE and working:
                yield after, stage, after.time - before.time
            working = working or (isinstance(after.record, TaskStarted) and stage not in _BEFORE)


def borrow_stage_one(source: Path, root: Path, settings: dict[str, Any], *, scores: bool = True) -> None:
    """Makes `root` a run with Stage I and, if wanted, the scores of the finished run `source`.

    Its settings are those of `source` but for `settings`, which must not concern what is taken. `panolog
    resume` continues it. What a killed attempt left in `root` is removed.
    """
    origin, copy = RunFolder(source), RunFolder(root)
    stages = (Stage.COARSE, Stage.SCORE) if scores else (Stage.COARSE,)
    if root.exists():
        rmtree(root)
    copytree(origin.model(COARSE).parent, copy.model(COARSE).parent)
    if scores:
        folder = origin.shard(TaskId.shard(0)).parent
        copytree(folder, root / folder.relative_to(source))
    kinds = (TaskStarted, Noticed, ModelSaved, ScoresSaved)
    done = [item.record for item in history(source) if isinstance(item.record, kinds)]
    with closing(Database(copy.database)) as database:
        database.append([r for r in done if isinstance(r.task, TaskId) and r.task.stage in stages])
    info = read_info(origin)
    write_info(copy, make_info(info.scene, change(info.config, settings)))  # last: makes it a run
