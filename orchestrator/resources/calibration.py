"""Measures a job before it starts: a calibration on the place where Stage I would run."""

import time
from typing import Any

from panolog.orchestrator.resources import placement
from panolog.orchestrator.resources.basis import Basis, assumed
from panolog.orchestrator.resources.messages import Ended, Failed, Hello
from panolog.orchestrator.resources.nodes import Place
from panolog.orchestrator.resources.placement import Request
from panolog.orchestrator.resources.pool import Pool
from panolog.orchestrator.run.config import RunConfig
from panolog.orchestrator.run.records import INPUT
from panolog.scene.errors import InputError
from panolog.scene.model import Scene
from panolog.workers import specs
from panolog.workers.events import Calibrated

_TASK = "calibrate"
_SECONDS = 3.0  # of iterations; with the worker's start about twice as many in all
_WAIT = 0.5  # seconds
_SHARE = 1 / 2  # of the place's memory that the attempt may take
_EACH = 2048  # bytes of a Gaussian in training, roughly


def calibrate(pool: Pool, scene: Scene, config: RunConfig) -> Basis:
    """Tries the job for a few seconds; assumes what was measured elsewhere if the attempt fails or none can.

    Raises InputError if the input is wrong.
    """
    cuda = config.device == "cuda"
    places = placement.place([Request(_TASK, 0)], pool.nodes(), (), cuda=cuda)
    if not places:
        return assumed(scene, config)
    place = places[0][1]
    began = time.monotonic()
    pool.start(_TASK, place, specs.calibrate_work, _fields(pool, scene, config, place))
    startup = 0.0
    measured: Calibrated | None = None
    while True:
        for _, message in pool.wait(_WAIT):
            match message:
                case Hello():
                    startup = time.monotonic() - began
                case Calibrated():
                    measured = message
                case Failed(reason, kind) if kind == INPUT:
                    raise InputError(reason)
                case Ended() | Failed():
                    return Basis(measured, startup) if measured else assumed(scene, config)


def _fields(pool: Pool, scene: Scene, config: RunConfig, place: Place) -> dict[str, Any]:
    """What `work.calibrate_work` needs."""
    node = next(node for node in pool.nodes() if node.id == place.node)
    memory = node.memory if place.gpu is None else node.gpus[place.gpu].memory or node.memory
    files = (file for row in scene.train for file in scene.panoramas[row].files)
    return {
        "scene": pool.put(scene),
        "width": config.width or scene.width,
        "iterations": config.iterations,
        "config": config,
        "seed": config.seed,
        "seconds": _SECONDS,
        "most": int(memory * _SHARE / _EACH),
        "device": config.device,
        "locate": pool.share_files(files, ()),
    }
