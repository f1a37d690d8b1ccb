"""What an estimate builds on: a calibration where Stage I would run, or the measurements of other jobs.

Each Gaussian has 59 floats of 4 bytes. Training keeps of each its value and two moments of Adam;
the rasterizer a splat of 64 bytes, as much for exact projection, and a few entries of tiles. On the CPU, a
densification has the new values next to the old ones, and where those and the old moments were, the next
ones, which are larger, find no room: 1.5 to 1.9 kB for each Gaussian were measured in all. On a GPU see
`workers.device_memory`. A checkpoint is a copy of values and moments in the host's memory.
"""

import json
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any

from pydantic import TypeAdapter

from panolog.orchestrator.engine.scheduling import placement
from panolog.orchestrator.engine.scheduling.placement import Demand
from panolog.orchestrator.engine.scheduling.pool import Ended, Failed, Hello, Pool
from panolog.orchestrator.engine.scheduling.scaling import Scaling
from panolog.orchestrator.runs.config import RunConfig
from panolog.orchestrator.runs.folder import RunFolder
from panolog.orchestrator.runs.machines.nodes import Placement
from panolog.orchestrator.runs.records import Failure
from panolog.scene.errors import ClusterError, InputError
from panolog.scene.images import MOST_THREADS, passing_views, view_bytes
from panolog.scene.model import Scene
from panolog.workers import device_memory
from panolog.workers.calibration import CalibrateSpec
from panolog.workers.device_memory import VALUES
from panolog.workers.events import Calibration, IterationCost
from panolog.workers.tasks import CALIBRATE

SPLAT = 2 * 64 + 72  # of the rasterizer's: the splat, its rays, some tile entries, the screen gradient
STEP = 3 * VALUES + 12 + SPLAT  # values, both moments, units of positions; gradients are never there at once
REARRANGED = 3 * VALUES + 16  # after a densification: where the old values and moments were, the indices
CHECKPOINT = 3 * VALUES + 28  # values, moments, units of positions, statistics
AVERAGE = VALUES + 12  # at the end of a task, when nothing is rearranged any more
TRAINED = STEP + REARRANGED  # peak bytes of one Gaussian in training on the CPU, checkpoints aside
PIXEL = 20 * 3 * 4  # bytes of one pixel of a training step there: some twenty float images
_PROCESS = 500 * 2**20  # bytes of a worker that trains, without Gaussians, images and panoramas
_DENSIFIED = 0.2  # share of Gaussians that densify at first: three scenes had 0.04 to 0.45

_SECONDS = 3.0  # of iterations; with the worker's start about twice as many in all
_WAIT_S = 0.5
_JOIN_S = 60.0  # in which a node joins a cluster whose nodes have just been started
_MEMORY_SHARE = 1 / 2  # of the placement's memory that the attempt may take
_EACH = 2048  # bytes of a Gaussian in training, roughly


@dataclass(frozen=True)
class Basis:
    """A calibration, and how long its worker took to start."""

    measured: Calibration
    startup: float  # seconds from the start of a task to its first message
    timed: bool = True  # False: nothing was measured, and times are not known
    joined: float | None = None  # seconds from the request for a machine until it was there

    def as_json(self) -> dict[str, Any]:
        """For `preflight.json`, where the calibration has the name of its task."""
        task = str(CALIBRATE) if self.timed else ""
        return asdict(self) | {"measured": {"task": task} | asdict(self.measured)}


def assumed(scene: Scene, config: RunConfig) -> Basis:
    """Without a calibration: memory and growth as other scenes had them, and no times."""
    width = config.width or scene.width
    pixels = width * (width // 2)
    gaussians = len(scene.points) + config.sky.number(pixels)
    if config.device == "cuda":
        views = passing_views(MOST_THREADS) * view_bytes(scene.panoramas[scene.train[0]], width)
        sample = IterationCost(gaussians, 0.0, _PROCESS, device_memory.training(gaussians, pixels) + views)
    else:
        sample = IterationCost(gaussians, 0.0, _PROCESS + pixels * PIXEL + gaussians * TRAINED, 0)
    measured = Calibration(
        width=width,
        threads=1,
        images=0,
        begin=0.0,
        decode=0.0,
        share=_DENSIFIED,
        initial=sample,
        grown=sample,
        single=0.0,
        look=0.0,
    )
    return Basis(measured, 0.0, timed=False)


def basis_of(folder: RunFolder, scene: Scene, config: RunConfig) -> Basis:
    """What the run was estimated on when it began; assumptions for one that is older than preflights."""
    try:
        return TypeAdapter(Basis).validate_python(json.loads(folder.preflight.read_bytes())["basis"])
    except (OSError, ValueError, KeyError, TypeError):  # a run can continue without it
        return assumed(scene, config)


def await_machine(
    pool: Pool, need: Callable[[], int], say: Callable[[str], None], *, cuda: bool
) -> float | None:
    """Waits until there is a machine for tasks, and requests it where Ray's autoscaler can start one.

    Returns after how many seconds that came; None if it was not requested. Raises ClusterError where none can
    be started and none joins.

    Args: need, returns the bytes of memory that a task should have; say, called with why it waits, and
    with "" when it does no more.
    """
    said, began = "", time.monotonic()
    while not placement.able(pool.nodes(), cuda=cuda):
        growth = pool.growth()
        groups = Scaling(growth, cuda, overhead=0.0).preferred(need())
        if groups:
            pool.request({groups[0].name: 0 if growth.joining else 1})
            text = f"waiting for a machine: {groups[0].text()} is requested from Ray's autoscaler"
            text += growth.report
        else:
            what = "GPU" if cuda else "core"
            text = f"waiting for a machine with a {what}: the cluster has none"
            if time.monotonic() - began > _JOIN_S:
                raise ClusterError(f"no node of the cluster has a {what} for tasks; see `ray status`")
        if text != said:
            say(text)
            said = text
        pool.ready(_WAIT_S)
    if said:
        say("")
    pool.request({})
    return time.monotonic() - began if said and pool.growth().groups else None


def calibrate(pool: Pool, scene: Scene, config: RunConfig) -> Basis:
    """Tries the job for a few seconds; assumes what was measured elsewhere if the attempt fails or hangs.

    Raises InputError if the input is wrong.
    """
    cuda = config.device == "cuda"
    leave = pool.notices()  # of nodes that announce their end
    there = placement.able(pool.nodes(), cuda=cuda)
    nodes = [node for node in there if node.id not in leave] or there
    placed = placement.place([Demand(CALIBRATE, 0)], nodes, (), cuda=cuda)
    if not placed:
        return assumed(scene, config)
    _, where = placed[0]
    latest = began = time.monotonic()
    deadline = config.deadlines.hello
    pool.start(where, _spec(pool, scene, config, where))
    startup = 0.0
    measured: Calibration | None = None
    while True:
        for task in pool.ready(_WAIT_S):
            message, latest = pool.take(task), time.monotonic()
            match message:
                case Hello():
                    startup, deadline = latest - began, config.deadlines.message
                case Calibration():
                    measured = message
                case Failed(reason, Failure.INPUT):
                    raise InputError(reason)
                case Ended() | Failed():
                    return Basis(measured, startup) if measured else assumed(scene, config)
        if time.monotonic() - latest > deadline:
            if not startup and pool.waiting(CALIBRATE):
                latest = time.monotonic()
                continue
            pool.cancel(CALIBRATE)
            return Basis(measured, startup) if measured else assumed(scene, config)


def _spec(pool: Pool, scene: Scene, config: RunConfig, where: Placement) -> CalibrateSpec:
    node = next(node for node in pool.nodes() if node.id == where.node)
    memory = node.memory if where.gpu is None else node.gpus[where.gpu].memory or node.memory
    files = (file for row in scene.train for file in scene.panoramas[row].files)
    return CalibrateSpec(
        scene=pool.put(scene),
        width=config.width or scene.width,
        iterations=config.iterations,
        config=config,
        seed=config.seed,
        seconds=_SECONDS,
        most=int(memory * _MEMORY_SHARE / _EACH),
        device=config.device,
        locate=pool.share_files(files, ()),
    )
