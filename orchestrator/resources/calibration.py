"""Measures a job before it starts: a calibration on the placement that Stage I would have."""

import time

from panolog.orchestrator.resources import placement
from panolog.orchestrator.resources.basis import Basis, assumed
from panolog.orchestrator.resources.nodes import Placement
from panolog.orchestrator.resources.placement import Demand
from panolog.orchestrator.resources.pool import Ended, Failed, Hello, Pool
from panolog.orchestrator.run.config import RunConfig
from panolog.orchestrator.run.records import Failure
from panolog.scene.errors import InputError
from panolog.scene.model import Scene
from panolog.workers.calibration import CalibrateSpec
from panolog.workers.events import Calibration
from panolog.workers.tasks import CALIBRATE

_SECONDS = 3.0  # of iterations; with the worker's start about twice as many in all
_WAIT_S = 0.5
_SHARE = 1 / 2  # of the placement's memory that the attempt may take
_EACH = 2048  # bytes of a Gaussian in training, roughly


def calibrate(pool: Pool, scene: Scene, config: RunConfig) -> Basis:
    """Tries the job for a few seconds; assumes what was measured elsewhere if the attempt fails or none can.

    Raises InputError if the input is wrong.
    """
    cuda = config.device == "cuda"
    placed = placement.place([Demand(CALIBRATE, 0)], pool.nodes(), (), cuda=cuda)
    if not placed:
        return assumed(scene, config)
    _, where = placed[0]
    began = time.monotonic()
    pool.start(where, _spec(pool, scene, config, where))
    startup = 0.0
    measured: Calibration | None = None
    while True:
        for _, message in pool.wait(_WAIT_S):
            match message:
                case Hello():
                    startup = time.monotonic() - began
                case Calibration():
                    measured = message
                case Failed(reason, Failure.INPUT):
                    raise InputError(reason)
                case Ended() | Failed():
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
        most=int(memory * _SHARE / _EACH),
        device=config.device,
        locate=pool.share_files(files, ()),
    )
