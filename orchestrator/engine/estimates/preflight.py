"""A job before it starts: measured, its blocks chosen, its needs compared with the machines."""

import math
import shutil
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from panolog.orchestrator.engine.estimates.calibration import Basis, assumed, await_machine, calibrate
from panolog.orchestrator.engine.estimates.costs import Estimate, StageEstimate
from panolog.orchestrator.engine.estimates.estimate import Estimator
from panolog.orchestrator.engine.estimates.place_parts import districts_of
from panolog.orchestrator.engine.estimates.suggestions import (
    DIVISIONS,
    Settings,
    balanced,
    problem,
    within_memory,
)
from panolog.orchestrator.engine.estimates.workers import Workers, workers
from panolog.orchestrator.engine.scheduling.pool import Pool
from panolog.orchestrator.engine.scheduling.scaling import Scaling
from panolog.orchestrator.runs.config import AUTO, RunConfig, change
from panolog.orchestrator.runs.machines.nodes import Node
from panolog.orchestrator.runs.money.prices import PriceList, price_by
from panolog.orchestrator.runs.state import ignore
from panolog.orchestrator.runs.units import duration, gib
from panolog.partition.assignment import OVERLAP
from panolog.partition.balance import Budget, fewest_blocks
from panolog.scene.errors import InputError
from panolog.scene.images import view_bytes
from panolog.scene.model import Scene
from panolog.workers import device_memory
from panolog.workers.tasks import Stage

# Whose Gaussians people want to know.
_TRAINED = {Stage.DISTRICT: "largest district", Stage.COARSE: "Stage I", Stage.BLOCK: "largest block"}
_CAMERAS = 16  # a block that is only there to keep a machine busy has at least so many


@dataclass(frozen=True)
class Preflight:
    config: RunConfig  # with its blocks chosen
    basis: Basis
    estimate: Estimate
    nodes: tuple[Node, ...]
    free: int  # bytes of the run folder's disk
    problem: str | None  # why the job cannot be done, in one line
    chosen: Settings  # that `memory` has led to
    workers: Workers

    def require(self) -> None:
        if self.problem:
            raise InputError(self.problem)

    def as_json(self) -> dict[str, Any]:
        return {
            "problem": self.problem,
            "estimate": self.estimate.as_json(),
            "machines": [asdict(node) for node in self.nodes],
            "free_disk": self.free,
            "basis": self.basis.as_json(),
            "workers": self.workers.as_json(),
        }

    def summary(self) -> str:
        trained = [
            f"{_TRAINED[it.name]} {it.gaussians:,}" for it in self.estimate.stages if it.name in _TRAINED
        ]
        cap = self.chosen.get("densify.max_gaussians")
        divided = ", ".join(f"{key}={value}" for key, value in self.chosen.items() if key in DIVISIONS)
        return (
            f"{time_of(self.estimate.seconds)} with blocks {self.estimate.blocks},"
            f" {gib(self.estimate.memory)} of memory for the largest task, {gib(self.estimate.disk)} of disk"
            f"; Gaussians, roughly: {', '.join(trained)}"
            + (f"; so that tasks fit into memory: {divided}" if divided else "")
            + (
                f"; a task trains at most {cap:,} scene Gaussians (memory, densify.max_gaussians)"
                if cap
                else ""
            )
            + self._cost()
        )

    def _cost(self) -> str:
        """What it costs on the machines that there are, for people; "" without prices."""
        if self.workers.price is None or self.estimate.seconds is None:
            return ""
        cost = len(self.nodes) * self.workers.price * self.estimate.seconds / 3600
        machines = f"{len(self.nodes)} x {self.workers.kind}"
        return f"; about {cost:,.2f} {self.workers.currency} on {machines}, storage not counted"


def examine(
    pool: Pool,
    scene: Scene,
    config: RunConfig,
    root: Path,
    prices: PriceList | None = None,
    say: Callable[[str], None] = ignore,
) -> Preflight:
    """Calibrates and estimates a job whose run folder is to be `root`; refuses nothing yet.

    Where there is no machine and an autoscaler can start one, one is requested and waited for. What it could
    start besides counts.

    Args: config with width and device resolved; prices of machines, if they are known; say, called with why
    it waits. Raises InputError if an image of the scene is wrong.
    """

    def need() -> int:
        return _whole(scene, config, assumed(scene, config)).memory

    joined = await_machine(pool, need, say, cuda=config.device == "cuda")
    basis = replace(calibrate(pool, scene, config), joined=joined)
    nodes = _potential(pool, scene, config, basis, prices)
    estimator, free = estimator_of(scene, config, basis, nodes), free_disk(root)
    chosen: Settings = {}
    if config.memory is not None and not config.densify.max_gaussians:

        def other(settings: Settings) -> Estimator:
            return estimator_of(scene, change(config, settings), basis, nodes)

        chosen = within_memory(estimator, other, free)
        estimator = other(chosen)
    why = problem(estimator, free)
    why = why and f"{scene.root}: {why}"
    final = change(config, chosen) if chosen else config

    def on(machines: Sequence[Node]) -> Estimator:
        if config.blocks == AUTO:
            return estimator_of(scene, final, basis, machines)
        other = replace(estimator, nodes=machines)
        vars(other)["parts"] = estimator.parts  # those of the place, which take long to count
        return other

    table = workers(on, nodes, prices)
    return Preflight(estimator.config, basis, estimator.estimate(), nodes, free, why, chosen, table)


def require_memory(scene: Scene | None, config: RunConfig) -> None:
    """Refuses a `memory` that is less than what a task takes without any Gaussians, before anything starts.

    Args: scene, if it is known; config with a width. Raises InputError, which says what is the least.
    """
    if scene is None or config.memory is None or config.memory * 2**30 >= device_memory.CONTEXT:
        return
    bare = change(config, {"densify.max_gaussians": 1, "cache.memory": config.memory})
    least = math.ceil(10 * _whole(scene, bare, assumed(scene, bare)).memory / 2**30) / 10
    raise InputError(
        f"{scene.root}: --memory {config.memory:g}GiB is too little for any task: at --width {config.width}"
        f" give at least {least:g}GiB"
    )


def _whole(scene: Scene, config: RunConfig, basis: Basis) -> Estimate:
    """The estimate of a job on one machine, one task after another."""
    one = config if config.decided else change(config, {"blocks": "1x1x1"})
    return Estimator(scene, one, basis, ()).estimate()


def _potential(
    pool: Pool, scene: Scene, config: RunConfig, basis: Basis, prices: PriceList | None
) -> tuple[Node, ...]:
    """The machines that a job may have: those that are there, and those that an autoscaler would start."""
    growth, nodes = pool.growth(), tuple(node for node in pool.nodes() if node.cpus or node.gpus)
    if not growth.groups:
        return nodes
    scaling = Scaling(
        growth,
        config.device == "cuda",
        config.scaling.overhead,
        known=growth.described(nodes),
        price=price_by(prices),
    )
    estimate = _whole(scene, config, basis)
    refining = [stage.seconds for stage in estimate.stages if stage.name is Stage.BLOCK]
    return tuple(scaling.potential(estimate.memory, sum(filter(None, refining)), nodes))


def estimator_of(scene: Scene, config: RunConfig, basis: Basis, nodes: Sequence[Node]) -> Estimator:
    """The estimator of a job, its cells decided if the settings leave that open.

    Raises InputError if there are not as many balanced blocks or districts as the settings request.
    """
    _check_districts(scene, config)
    if config.decided:
        return Estimator(scene, config, basis, nodes)
    if config.blocks == AUTO:
        whole = Estimator(scene, change(config, {"blocks": "1x1x1"}), basis, nodes)
        settings = balanced(scene, config, choose_blocks(whole))
    else:
        settings = balanced(scene, config, int(config.blocks))
        if settings["blocks"] != config.blocks:
            cameras, fewest = len(scene.train), config.partition.min_cameras
            raise InputError(
                f"{scene.root}: {cameras} training panoramas are enough for --blocks {settings['blocks']}"
                f" with partition.min_cameras={fewest}, not for {config.blocks}"
            )
    return Estimator(scene, change(config, settings), basis, nodes)


def _check_districts(scene: Scene, config: RunConfig) -> None:
    if config.districts == 1:
        return
    found, fewest = districts_of(scene, config).count, config.partition.min_cameras
    if found != config.districts:
        raise InputError(
            f"{scene.root}: {len(scene.train)} training panoramas are enough for --set districts={found} with"
            f" partition.min_cameras={fewest}, not for {config.districts}"
        )


def choose_blocks(estimator: Estimator) -> int:
    """How many blocks `--blocks auto` has: as memory requires, and no fewer than keep all machines busy.

    A block's panoramas must stay decoded within `cache.memory` and what Gaussians leave of its memory. A task
    may double what lies in its own cell; it holds all of Stage I, unless what is outside is baked.
    """
    scene, config = estimator.scene, estimator.config
    train = list(scene.train)
    coarse = estimator.estimate().coarse
    have = estimator.largest
    view = max(view_bytes(scene.panoramas[row], estimator.width) for row in train)
    images = config.cache.memory * 2**30
    if config.device == "cpu":  # where panoramas and Gaussians are in the same memory
        images = min(images, have - estimator.memory(coarse, 0))
    held = estimator.capacity(have) / coarse if have else math.inf
    room = held / 2 if estimator.bakes else held - 1
    cameras = images / view / OVERLAP
    budget = Budget(max(1.0, cameras), max(1e-3, room))
    least = max(1, min(estimator.slots(estimator.host(coarse, len(train))), len(train) // _CAMERAS))
    centers, fewest = scene.centers[train], config.partition.min_cameras
    box = config.partition.box(centers)
    return fewest_blocks(centers, scene.points, box, budget, least=least, fewest=fewest)


def free_disk(root: Path) -> int:
    """Bytes that are free where the (perhaps future) folder `root` is."""
    place = next(folder for folder in (root.absolute(), *root.absolute().parents) if folder.exists())
    return shutil.disk_usage(place).free


def machine_line(node: Node) -> str:
    gpus = ", ".join(f"{gpu.name} with {gib(gpu.memory)} free" for gpu in node.gpus)
    return f"{node.cpus} cores, {gib(node.memory)} of memory free" + (f", {gpus}" if gpus else "")


def stage_line(stage: StageEstimate) -> str:
    gpu = f"{gib(stage.device)} of a GPU, " if stage.device else ""
    host = f"{gib(stage.host)} of memory, " if stage.host else ""
    tasks = f"{stage.tasks} tasks, {stage.together} at a time, " if stage.tasks > 1 else ""
    return f"{tasks}{stage.gaussians:,} Gaussians, {gpu}{host}{time_of(stage.seconds)}"


def time_of(seconds: float | None) -> str:
    return "time not measured" if seconds is None else f"about {duration(seconds)}"
