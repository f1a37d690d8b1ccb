"""What training loses to other busy processes: its rate when idle, with one core taken, and with all.

    python -m benchmarks.contention [--scene SCENE] [--width 512] [--rounds 3] [--seconds 6]
    python -m benchmarks.contention --quick

One Stage I, started as `panolog run` starts it, trains for the whole measurement: a small town, or a scene.
Meanwhile busy loops at the priority of this process start and end, one for each core that is taken, and the
iterations in each phase count. The phases take turns, so that nothing else differs between them. The goal is
for one of two cores: the fair share of two threads among three on two cores is two thirds of the idle rate.
"""

import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from statistics import median

from benchmarks import report
from panolog.orchestrator.cluster.connection import connect
from panolog.orchestrator.driver.job import Job, Specs
from panolog.orchestrator.resources.machine import cores
from panolog.orchestrator.resources.nodes import Placement
from panolog.orchestrator.resources.pool import Ended, Failed, Pool
from panolog.orchestrator.run.config import load_config
from panolog.orchestrator.run.folder import RunFolder
from panolog.scene.errors import RunError
from panolog.scene.read import read_scene
from panolog.synthetic.make import make_town
from panolog.workers.events import Progress
from panolog.workers.tasks import COARSE

HEAD = ("cores taken", "of", "iterations/s", "least", "most", "ratio to idle")
GOAL = 0.45  # of the idle rate, with one of two cores taken
_ENDLESS = 10**6  # iterations
_SETTLE_S = 1.5  # after a busy loop starts or ends: the interval of two reports, and their way here
_WAIT_S = 0.5
_BUSY = "while True: pass"


@dataclass(frozen=True)
class Phase:
    """The rates with so many cores taken."""

    taken: int
    cores: int
    rates: tuple[float, ...]  # iterations per second, of each turn


@dataclass(frozen=True)
class Size:
    """What is measured."""

    width: int  # pixels
    rounds: int
    seconds: float  # of each phase in each round


def measure(folder: Path, scene: Path, size: Size) -> tuple[Phase, ...]:
    """Idle, one core taken, all. Raises RunError if the training fails, InputError by the scene."""
    steady = {"iterations": _ENDLESS, "densify.until": 0, "preview.every": _ENDLESS}
    flags = {"width": size.width, "device": "cpu", "checkpoint.every": _ENDLESS}
    job = Job(RunFolder(folder / "run"), read_scene(scene), load_config(flags=steady | flags))
    phases = dict.fromkeys((0, 1, cores()))
    rates: dict[int, list[float]] = {taken: [] for taken in phases}
    with connect(None, folder) as pool:
        (node,) = pool.nodes()
        pool.start(Placement(node.id, cores(), node.memory), Specs(job, pool).of(COARSE))
        _rate(pool, size.seconds)  # warm-up
        for turn in range(size.rounds):
            for taken in phases if turn % 2 else reversed(phases):
                with _busy(taken):
                    rates[taken].append(_rate(pool, size.seconds))
                    print(
                        f"turn {turn + 1}: {taken} taken: {rates[taken][-1]:.2f}/s",
                        file=sys.stderr,
                        flush=True,
                    )
    return tuple(Phase(taken, cores(), tuple(found)) for taken, found in rates.items())


@contextmanager
def _busy(count: int) -> Iterator[None]:
    """That many busy loops, each in a process."""
    loops = [subprocess.Popen([sys.executable, "-c", _BUSY]) for _ in range(count)]
    try:
        yield
    finally:
        for loop in loops:
            loop.kill()
            loop.wait()


def _rate(pool: Pool, seconds: float) -> float:
    """Iterations per second, between two reports of the worker that are about `seconds` apart."""
    began = time.monotonic() + _SETTLE_S
    first: tuple[float, int] | None = None
    while True:
        for task in pool.ready(_WAIT_S):
            now = time.monotonic()
            match pool.take(task):
                case Failed(reason):
                    raise RunError(reason)
                case Ended():
                    raise RunError("the training has ended before its measurement")
                case Progress(iteration=iteration) if first is None and now >= began:
                    first = (now, iteration)
                case Progress(iteration=iteration) if first is not None and now - first[0] >= seconds:
                    return (iteration - first[1]) / (now - first[0])
                case _:
                    pass


def rows(phases: Sequence[Phase]) -> list[tuple[object, ...]]:
    """The table: medians, spread and ratio to idle."""
    idle = median(phases[0].rates)
    return [
        (p.taken, p.cores, median(p.rates), min(p.rates), max(p.rates), median(p.rates) / idle)
        for p in phases
    ]


def main(arguments: Sequence[str] | None = None) -> int:
    """The program; returns its exit code: 1 if one of two cores costs more than the goal allows."""
    parser = report.parser("contention", __doc__)
    parser.add_argument("--scene", type=Path, help="default: a small synthetic town")
    parser.add_argument("--width", type=int, default=512, help="of the panoramas, in pixels")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--seconds", type=float, default=6.0, help="of each phase in each round")
    options = parser.parse_args(arguments)
    size = Size(64, 1, 0.1) if options.quick else Size(options.width, options.rounds, options.seconds)

    def work() -> report.Report:
        with tempfile.TemporaryDirectory(prefix="contention-") as folder:
            scene = options.scene or make_town(Path(folder) / "town", panoramas=9, width=size.width)
            found = measure(Path(folder), scene, size)
        table = rows(found)
        ratio = next(float(str(row[-1])) for row in table if row[0] == 1)
        passed = options.quick or cores() != 2 or ratio >= GOAL
        content = {"size": asdict(size), "phases": [asdict(phase) for phase in found], "passed": passed}
        return report.Report(content, report.markdown(HEAD, table), passed=passed)

    return report.run("contention", options, work)


if __name__ == "__main__":
    sys.exit(main())
