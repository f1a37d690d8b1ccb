"""Bytes and seconds of a city's tasks, by its size and the width of its panoramas: what preflight estimates.

The estimator is the product's. It has calibrated itself on a small city of the same kind on this machine, at
the widths that are here; what lies beyond is its law.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeAlias

from matplotlib.axes import Axes

from benchmarks.paper.curves import svg
from benchmarks.scale.models import PER_BLOCK
from benchmarks.scale.places import city
from panolog.orchestrator.engine.driver.local_pool import local_pool
from panolog.orchestrator.engine.estimates.calibration import Basis, assumed, calibrate
from panolog.orchestrator.engine.estimates.costs import StageEstimate
from panolog.orchestrator.engine.estimates.estimate import Estimator
from panolog.orchestrator.engine.estimates.suggestions import DETAIL, balanced
from panolog.orchestrator.runs.config import RunConfig, change
from panolog.orchestrator.runs.machines.nodes import Node
from panolog.orchestrator.watch.views.palette import BLOCK_COLORS
from panolog.scene.model import Scene
from panolog.scene.read import read_scene
from panolog.workers.tasks import Stage

Value: TypeAlias = Callable[["Law"], float]


@dataclass(frozen=True)
class Law:
    """The largest tasks of a city. Bytes on the CPU, and of a GPU; seconds on the machine that calibrated."""

    panoramas: int
    blocks: int
    width: int  # pixels
    gaussians: int  # of Stage I
    coarse: int  # bytes of Stage I as one task
    coarse_gpu: int
    coarse_seconds: float
    score: int  # bytes of a shard
    score_seconds: float
    block_gaussians: int  # that the fullest block trains
    block: int
    block_gpu: int
    block_seconds: float


@dataclass(frozen=True)
class Calibrated:
    """What one width has measured."""

    width: int
    gaussians: tuple[int, int]  # of the two models
    seconds: tuple[float, float]  # of an iteration with them
    host: int  # bytes: the peak of the process with the second
    threads: int


def settings(width: int, device: str, iterations: int = 30_000) -> RunConfig:
    """Of a city: the defaults, with levels of detail."""
    return RunConfig.model_validate(
        {"width": width, "device": device, "iterations": iterations, "stage2": {"detail": DETAIL}}
    )


def calibrated(scene: Path, widths: Sequence[int], repeats: int = 3) -> dict[int, Basis]:
    """What preflight measures for a scene at each width, the fastest of some times: other work only slows it.

    Raises InputError if the scene is wrong.
    """
    read = read_scene(scene)
    with local_pool() as pool:
        return {
            width: _fastest([calibrate(pool, read, settings(width, "cpu")) for _ in range(repeats)])
            for width in widths
        }


def _fastest(bases: Sequence[Basis]) -> Basis:
    """The one with the fastest iterations of the grown model, and the fastest of the initial one."""
    best = min(bases, key=lambda basis: basis.measured.grown.seconds)
    initial = min((basis.measured.initial for basis in bases), key=lambda cost: cost.seconds)
    return replace(best, measured=replace(best.measured, initial=initial))


def shown(bases: dict[int, Basis]) -> list[Calibrated]:
    """What the laws rest on."""
    measured = [basis.measured for basis in bases.values()]
    return [
        Calibrated(
            at.width,
            (at.initial.gaussians, at.grown.gaussians),
            (at.initial.seconds, at.grown.seconds),
            at.grown.host,
            at.threads,
        )
        for at in measured
    ]


def laws(bases: dict[int, Basis], sizes: Sequence[int], widths: Sequence[int]) -> Iterator[Law]:
    """Of cities of so many panoramas at each width, which has the calibration of the nearest one below."""
    for panoramas in sizes:
        scene = city(panoramas, max(widths))
        for width in widths:
            below = max((known for known in bases if known <= width), default=min(bases))
            yield _law(replace(scene, width=width, height=width // 2), bases[below])


def _law(scene: Scene, basis: Basis) -> Law:
    config = settings(scene.width, "cpu")
    blocks = max(2, round(len(scene.panoramas) / PER_BLOCK))
    config = change(config, balanced(scene, config, blocks))
    here = (Node("here", "here", basis.measured.threads, 2**60),)
    job = Estimator(scene, config, basis, here)
    on_gpu = replace(job, config=change(config, {"device": "cuda"}))
    on_gpu = replace(on_gpu, basis=assumed(scene, on_gpu.config))
    stages = {stage.name: stage for stage in job.estimate().stages}
    cards = {stage.name: stage for stage in on_gpu.estimate().stages}
    coarse, score, block = (stages[name] for name in (Stage.COARSE, Stage.SCORE, Stage.BLOCK))
    return Law(
        panoramas=len(scene.panoramas),
        blocks=config.grid.count,
        width=scene.width,
        gaussians=coarse.gaussians,
        coarse=coarse.host,
        coarse_gpu=cards[Stage.COARSE].device,
        coarse_seconds=coarse.seconds or math.nan,
        score=score.host,
        score_seconds=_of_one(score),
        block_gaussians=block.gaussians,
        block=block.host,
        block_gpu=cards[Stage.BLOCK].device,
        block_seconds=_of_one(block),
    )


def _of_one(stage: StageEstimate) -> float:
    """Seconds of one task, where as many run at a time as `together` says."""
    return (stage.seconds or math.nan) / math.ceil(stage.tasks / stage.together)


def pictures(found: Sequence[Law]) -> dict[str, str]:
    """Bytes and seconds of a block against the size of the city, as SVG by name."""
    widths = sorted({law.width for law in found})

    def curve(title: str, unit: str, value: Value) -> str:
        def draw(axes: Axes) -> None:
            for number, width in enumerate(widths):
                rows = [law for law in found if law.width == width]
                color = BLOCK_COLORS[number % len(BLOCK_COLORS)]
                sizes = [row.panoramas for row in rows]
                values = [value(row) for row in rows]
                label = f"{width}×{width // 2}"
                axes.plot(sizes, values, color=color, lw=1.6, marker="o", ms=3, label=label)
            axes.set_xscale("log")
            axes.set_yscale("log")
            axes.set_ylim(bottom=min(map(value, found)) / 8)  # room for the legend
            axes.set_xlabel("panoramas of the city")
            axes.set_ylabel(unit)

        return svg(draw, title)

    return {
        "block-memory": curve("Memory of the largest block on the CPU", "GiB", lambda law: law.block / 2**30),
        "block-hours": curve("Time of the largest block", "hours", lambda law: law.block_seconds / 3600),
    }
