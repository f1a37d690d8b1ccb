"""Cities of more and more panoramas, in districts and blocks of one size: what their largest tasks take."""

import itertools
import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from statistics import median
from typing import Any

from matplotlib.axes import Axes

from benchmarks.paper.curves import svg
from benchmarks.runs import history, panolog
from panolog.orchestrator.engine.estimates.parts import districts_of
from panolog.orchestrator.engine.estimates.suggestions import DETAIL
from panolog.orchestrator.runs.config import RunConfig
from panolog.orchestrator.runs.records import Merged, Progressed, Stored
from panolog.orchestrator.watch.views.palette import BLOCK_COLORS
from panolog.scene.model import Scene
from panolog.scene.read import read_scene
from panolog.synthetic.make import make_city
from panolog.workers.tasks import Stage, TaskId

NAMES = {
    "coarse": "Stage I",
    "score": "scores",
    "block": "a block",
    "repair": "the repair of a seam",
    "measure": "a shard of the evaluation",
}
_DONE = "sparse/0/points3D.bin"  # the last file of a scene


@dataclass(frozen=True)
class Size:
    """Of the measured runs."""

    width: int  # pixels
    iterations: int  # of Stage I and of each block
    district: int = 66  # panoramas that train one at most: all that a city of 75 has
    block: float = 37.5  # panoramas of the city for each
    cache: float = 0.125  # GiB of decoded panoramas and what is baked for them


@dataclass(frozen=True)
class Tasks:
    """All tasks of a stage, each alone on one core. The largest counts, whichever that is."""

    count: int
    gaussians: int
    memory: int  # bytes: the peak of its process
    seconds: float  # of an iteration, the median of its second half


@dataclass(frozen=True)
class City:
    """One run."""

    panoramas: int
    gaussians: int  # of the merged model
    stages: dict[str, Tasks]

    @staticmethod
    def parse(found: dict[str, Any]) -> "City":
        """The inverse of `asdict`."""
        stages = {name: Tasks(**tasks) for name, tasks in found["stages"].items()}
        return City(found["panoramas"], found["gaussians"], stages)


def cities(disk: Path, scenes: Path, sizes: Sequence[int], size: Size) -> Iterator[City]:
    """Runs a city of each size. Args: scenes, folder of the scenes; those that are missing are made.

    Raises RunError if a run fails.
    """
    for panoramas in sizes:
        scene, root = scenes / f"city-{panoramas}", disk / f"run-{panoramas}"
        if not (scene / _DONE).exists():
            make_city(scene, panoramas=panoramas, width=size.width)
        blocks, districts = max(2, round(panoramas / size.block)), _districts(read_scene(scene), size)
        settings = {
            **{"districts": districts, "stage2.detail": DETAIL, "cache.memory": size.cache},
            **{"eval.seams": 0, "retries": 0},
        }
        with _one_core():
            panolog(
                *("run", str(scene), "-o", str(root), "--device", "cpu", "--width", str(size.width)),
                *("--blocks", str(blocks), "--iterations", str(size.iterations)),
                *(word for key, value in settings.items() for word in ("--set", f"{key}={value}")),
            )
        yield _city(panoramas, history(root))


def _districts(scene: Scene, size: Size) -> int:
    """The fewest of which none has too many panoramas, or as many as there are panoramas for."""
    if len(scene.train) <= size.district:
        return 1
    for count in itertools.count(2):
        found = districts_of(scene, RunConfig(districts=count))
        if found.count < count or found.cameras.sum(axis=1).max() <= size.district:
            return found.count
    raise AssertionError("there is a limit")


@contextmanager
def _one_core() -> Iterator[None]:
    """Processes that start have one core: their tasks run one after another, each with one thread."""
    allowed = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {min(allowed)})
    try:
        yield
    finally:
        os.sched_setaffinity(0, allowed)


def _city(panoramas: int, records: Sequence[Stored]) -> City:
    progress: dict[Stage, dict[TaskId, list[Progressed]]] = {}
    gaussians = 0
    for record in (stored.record for stored in records):
        if isinstance(record, Progressed):
            stage = Stage.COARSE if record.task.stage is Stage.DISTRICT else record.task.stage
            progress.setdefault(stage, {}).setdefault(record.task, []).append(record)
        if isinstance(record, Merged):
            gaussians = record.gaussians
    stages = {name: _largest(progress[Stage(name)]) for name in NAMES if Stage(name) in progress}
    return City(panoramas, gaussians, stages)


def _largest(tasks: dict[TaskId, list[Progressed]]) -> Tasks:
    return Tasks(
        len(tasks),
        max(record.gaussians or 0 for records in tasks.values() for record in records),
        max(record.host_peak or 0 for records in tasks.values() for record in records),
        max(map(_seconds, tasks.values())),
    )


def _seconds(records: Sequence[Progressed]) -> float:
    """Of an iteration. The first report also counts what precedes the first iteration."""
    later = [r.rate for r in records if r.rate > 0 and r.iteration > r.iterations / 2]
    return 1 / median(later) if later else 0.0


def growth(found: Sequence[City], stage: str) -> tuple[float, float]:
    """Memory and seconds of the largest task of a stage: in the largest city, over those in the smallest."""
    first, last = (city.stages[stage] for city in (found[0], found[-1]))
    return last.memory / first.memory, last.seconds / first.seconds


def pictures(found: Sequence[City]) -> dict[str, str]:
    """Memory and time of the largest tasks against the size of the city, as SVG by name."""

    def curve(title: str, unit: str, field: str, scale: float) -> str:
        def draw(axes: Axes) -> None:
            for number, (stage, label) in enumerate(NAMES.items()):
                rows = [city for city in found if stage in city.stages]
                if not rows:
                    continue
                sizes = [city.panoramas for city in rows]
                values = [asdict(city.stages[stage])[field] * scale for city in rows]
                color = BLOCK_COLORS[number % len(BLOCK_COLORS)]
                axes.plot(sizes, values, color=color, lw=1.6, marker="o", ms=3, label=label)
            axes.set_xscale("log")
            axes.set_xticks([city.panoramas for city in found], [f"{city.panoramas:,}" for city in found])
            axes.minorticks_off()
            axes.set_ylim(bottom=0)
            axes.set_xlabel("panoramas of the city")
            axes.set_ylabel(unit)

        return svg(draw, title)

    return {
        "city-memory": curve("Peak memory of the largest task", "GiB", "memory", 2**-30),
        "city-iteration": curve("An iteration of the slowest task", "ms", "seconds", 1e3),
    }
