"""Why a job does not fit, and the settings with which it would."""

import math
import shutil
import socket
import tempfile
from bisect import bisect_left
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import TypeAlias, TypeVar

from panolog.orchestrator.engine.estimates.costs import Estimate
from panolog.orchestrator.engine.estimates.estimate import Estimator
from panolog.orchestrator.engine.scheduling.placement import USABLE
from panolog.orchestrator.runs.config import RunConfig, change
from panolog.orchestrator.runs.machines.nodes import Node
from panolog.orchestrator.runs.units import gib
from panolog.partition.balance import balance
from panolog.scene.errors import InputError
from panolog.scene.model import Scene
from panolog.workers.tasks import Stage
from panolog.workers.training.exterior import Rooms

_STEP = 64  # pixels between widths that are proposed
_NARROWEST = 256  # pixels
_PARTS = (2, 4, 8, 16, 32, 64, 128, 256)  # districts or blocks, of which the first that fits is proposed
DETAIL = 8.0  # pixels that a Gaussian of a level of detail spans
_CACHED = 8  # of the memory of a task, the part that decoded panoramas may take where it is short
DIVISIONS = ("districts", "stage2.detail", "cache.memory")  # by which tasks get smaller, not what they train
_NAMES = {
    Stage.DISTRICT: "Stage I of a district",
    Stage.COARSE: "Stage I",
    Stage.SCORE: "scoring",
    Stage.BLOCK: "a block",
    Stage.ROUND: "a block in its second round",
    Stage.REPAIR: "the repair of a seam",
    Stage.MEASURE: "a part of the evaluation",
    Stage.EVAL: "the evaluation",
}
_Value = TypeVar("_Value", int, float)
Settings: TypeAlias = dict[str, object]  # by dotted key


def balanced(scene: Scene, config: RunConfig, blocks: int) -> Settings:
    """The settings of so many balanced blocks, or of as many as there are cameras for."""
    centers, partition = scene.centers[list(scene.train)], config.partition
    cells = balance(centers, scene.points, partition.box(centers), blocks, partition.min_cameras)
    return {"blocks": str(cells.count), "partition.cuts": cells.cuts}


def problem(estimator: Estimator, free: int) -> str | None:
    """Why the job cannot be done, in one line that ends with what would help; None if it can.

    Args: free, bytes of the run folder's disk.
    """
    estimate = estimator.estimate()
    short = _shortage(estimator, estimate, free)
    if short is None:
        return None

    def fits(settings: Settings) -> bool:
        other = replace(estimator, config=change(estimator.config, settings))
        return _shortage(other, other.estimate(), free) is None

    ways = list(_ways(estimator, estimate, fits))
    advice = (
        f"it fits with {' or with '.join(ways)}" if ways else "take a machine with more, or fewer panoramas"
    )
    return f"{short.what}; {advice}"


def within_memory(estimator: Estimator, other: Callable[[Settings], Estimator], free: int) -> Settings:
    """Settings with which all tasks fit: none if they do as it is, or if there is no way.

    At first a smaller cache, levels of detail and the fewest districts, which leave all Gaussians; where that
    does not help, or there are too few panoramas, as many Gaussians in a task as fit.

    Args: other, the job with such settings, raises InputError for too few panoramas; free as `problem`.
    """

    def missing(settings: Settings) -> _Short | None:
        found = other(settings)
        return _shortage(found, found.estimate(), free)

    tried: list[Settings] = [{}]
    for settings in ({}, *_divisions(estimator)):
        try:
            short = missing(settings)
        except InputError:
            break
        if short is None:
            return settings
        tried.append(settings)
        if not short.memory:
            break
    for settings in (tried[0], tried[-1]):
        whole = other(settings)

        def capped(cap: int, settings: Settings = settings) -> Settings:
            return {**settings, "densify.max_gaussians": cap}

        if cap := _last(_caps(whole, whole.estimate()), lambda value: missing(capped(value)) is None):
            return capped(cap)
    return {}


def _divisions(estimator: Estimator) -> Iterator[Settings]:
    """Settings that divide a place further, the fewest districts first."""
    config, cache = estimator.config, _smaller_cache(estimator)
    if cache:
        yield cache
    if not config.refine:
        return
    detail: Settings = {} if config.stage2.detail else {"stage2.detail": DETAIL}
    if detail:
        yield detail
    if detail and cache:
        yield {**detail, **cache}
    for districts in _PARTS:
        if districts > config.districts:
            yield {"districts": districts, **detail, **cache}


def _smaller_cache(estimator: Estimator) -> Settings:
    """A part of a task's memory for decoded panoramas and what is baked; nothing if they need no more."""
    config = estimator.config
    if config.memory is None or config.device == "cuda":
        return {}
    most = config.memory / _CACHED
    needed = len(estimator.scene.train) * estimator.kept_view / 2**30
    return {"cache.memory": round(most, 3)} if min(needed, config.cache.memory) > most else {}


def _caps(estimator: Estimator, estimate: Estimate) -> list[int]:
    """Values of `densify.max_gaussians` to try, ascending: a tenth of the points to what is expected."""
    points, largest = len(estimator.scene.points), max(stage.gaussians for stage in estimate.stages)
    more = {_rounded(points + (largest - points) * i // 100) for i in range(1, 100)}
    fewer = {max(1, points * i // 10) for i in range(1, 10)}  # 0 is no cap
    return sorted(fewer | {cap for cap in more if cap >= points})


@dataclass(frozen=True)
class _Short:
    memory: bool  # of a task, which is less where the place is divided; or else the disk
    what: str  # in words


def _shortage(estimator: Estimator, estimate: Estimate, free: int) -> _Short | None:
    """The first stage that needs more than any machine has, or the disk."""
    cuda = estimator.config.device == "cuda"
    workers = [node for node in estimator.nodes if node.gpus or not cuda]
    host = max((node.memory for node in workers), default=0) if cuda else estimator.largest
    device = estimator.largest if cuda else 0
    for stage in estimate.stages:
        for what, need, have in (("GPU memory", stage.device, device), ("memory", stage.host, host)):
            if need > have > 0:
                name = _NAMES.get(stage.name, str(stage.name))
                words = f"{name}, with {stage.gaussians:,} Gaussians, needs about {gib(need)} of {what}"
                return _Short(memory=True, what=f"{words}, and {gib(have)} are free")
    if estimate.disk > free:
        disk = f"the run folder needs about {gib(estimate.disk)}, and {gib(free)} of its disk are free"
        return _Short(memory=False, what=disk)
    if (baked := _baked(estimator, estimate)) > (left := free_temporary(estimator.nodes)):
        where = f"{tempfile.gettempdir()}, and {gib(int(left))} are free there (TMPDIR)"
        files = f"what is baked for the panoramas of a block needs about {gib(baked)} in {where}"
        return _Short(memory=False, what=files)
    return None


def free_temporary(nodes: Sequence[Node]) -> float:
    """Bytes that are free for temporary files where tasks run; inf where that is not only this machine."""
    here = {node.host for node in nodes} == {socket.gethostname()}
    return shutil.disk_usage(tempfile.gettempdir()).free if here else math.inf


def _baked(estimator: Estimator, estimate: Estimate) -> int:
    """Bytes in files of what is baked for blocks that train together, beyond what they keep in memory."""
    stage = next((stage for stage in estimate.stages if stage.name is Stage.BLOCK), None)
    if stage is None or not estimator.bakes:
        return 0
    cache, device, scene = estimator.config.cache, estimator.config.device, estimator.scene
    if device != "cpu" and cache.device is None:  # as the driver gives it
        left = max(0.0, USABLE * estimator.largest - stage.device) / 2**30
        cache = cache.model_copy(update={"device": left})
    room = Rooms.of(cache, device, scene.panoramas[scene.train[0]], estimator.width, bakes=True).baked
    return stage.together * max(0, estimator.parts.block_cameras * estimator.baked_view - room)


def _ways(estimator: Estimator, estimate: Estimate, fits: Callable[[Settings], bool]) -> Iterator[str]:
    """One setting each, with the value nearest to what was wanted that fits."""
    config = estimator.config
    tenths = [i / 10 for i in range(1, math.ceil(config.cache.memory * 10))]
    if cache := _last(tenths, lambda value: fits({"cache.memory": value})):
        yield f"--set cache.memory={cache}"
    if cap := _last(_caps(estimator, estimate), lambda value: fits({"densify.max_gaussians": value})):
        yield f"--set densify.max_gaussians={cap}"
    widths = range(_NARROWEST, config.width or estimator.scene.width, _STEP)
    if width := _last(widths, lambda value: fits({"width": value})):
        yield f"--width {width}"
    if config.refine and (blocks := _blocks(estimator, fits)):
        yield f"--blocks {blocks}"
    if divided := next(filter(fits, _divisions(estimator)), None):
        yield " ".join(f"--set {key}={value}" for key, value in divided.items())


def _last(values: Sequence[_Value], fits: Callable[[_Value], bool]) -> _Value | None:
    """The last of ascending values that fits, where all before it fit too."""
    position = bisect_left(values, True, key=lambda value: not fits(value))
    return values[position - 1] if position else None


def _rounded(count: int) -> int:
    """To two digits, downwards."""
    unit: int = 10 ** max(0, len(str(count)) - 2)
    return count // unit * unit


def _blocks(estimator: Estimator, fits: Callable[[Settings], bool]) -> int | None:
    """The fewest balanced blocks, of those that are tried, with which it fits: more than now."""
    config = estimator.config
    for blocks in _PARTS:
        if blocks > config.grid.count:
            settings = balanced(estimator.scene, config, blocks)
            if settings["blocks"] == str(blocks) and fits(settings):
                return blocks
    return None
