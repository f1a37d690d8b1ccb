"""How long the parts of making a scene take, and the training after it, before anything of a run is measured.

In seconds of one core, as two captures took them, a flat of 11 panoramas and a street of 64; of networks
assumed. Only ratios count, and most machines share those. The preflight replaces all of it by measurements.
"""

import math
from pathlib import Path

from panolog.orchestrator.runs.config import RunConfig
from panolog.orchestrator.runs.machines.machine import cores
from panolog.orchestrator.runs.preparation.settings import Settings, Step

BEFORE_MASKS = ("frames", "stitching", "metadata", "sizes")  # parts of finding poses, in order
PARTS: dict[Step, tuple[str, ...]] = {  # of steps, in order, as they name them in their progress
    Step.MASKS: ("static regions", "masks"),
    Step.SFM: (*BEFORE_MASKS, "features", "look-alikes", "matches", "poses", "scene"),
    Step.DEPTH: ("depth",),
    Step.CHECK: ("check",),
}
_FRAME, _FRAME_MEGAPIXEL = 0.06, 0.005  # of a video
_KEPT = 30  # frames, of which one becomes a panorama
_OF_PANORAMA = {"poses": 0.7, "scene": 0.03, "check": 0.15}
_OF_MEGAPIXEL = {"static regions": 0.05, "masks": 0.05, "features": 1.4}
_NETWORK = 5.0  # for a panorama
_LOOK = 0.0004  # to see whether two panoramas look alike: all are compared
_PAIR, _PAIRS = 0.065, 7  # to match two panoramas; so many pairs for each
_SERIAL = ("poses", "scene")  # parts of one process
REPEATED = {"poses": 0.25}  # parts that begin again, an unknown number of times: what is taken for done

_ITERATION, _ON_GPU = 0.5, 0.004  # of a megapixel
_LONG = 30_000  # iterations, of which one takes twice as long: there are more Gaussians
_BLOCK, _OTHERS = 0.75, 0.2  # of Stage I: a block; scores, repair and evaluation
_MEASURING = 15.0  # exposures, and to calibrate
DRIVER = Path("/proc/driver/nvidia/version")  # which is there where there is a GPU


def parts_of(settings: Settings, chosen: int | None = None) -> dict[tuple[Step, str], float]:
    """Seconds of each part of each step of a preparation. Args: chosen, how many panoramas, if known."""
    frames = settings.panoramas if settings.video else 0
    count = chosen or max(1, frames // _KEPT if settings.video else settings.panoramas)
    size = settings.width * (settings.width // 2) / 1e6
    found = {
        (step, part): count * (_OF_PANORAMA.get(part, 0.0) + size * _OF_MEGAPIXEL.get(part, 0.0))
        for step in settings.steps()
        for part in PARTS[step]
    }
    found[Step.SFM, "frames"] = frames * (_FRAME + size * _FRAME_MEGAPIXEL)
    every = count * (count - 1) // 2
    found[Step.SFM, "look-alikes"] = _LOOK * every
    found[Step.SFM, "matches"] = _PAIR * min(_PAIRS * count, every)
    if settings.mask_model:
        found[Step.MASKS, "masks"] += count * _NETWORK
    if settings.depth_model:
        found[Step.DEPTH, "depth"] = count * _NETWORK
    together = cores()
    return {key: took / (1 if key[1] in _SERIAL else together) for key, took in found.items()}


def training(config: RunConfig, width: int) -> float:
    """Seconds of all that follows a preparation. Args: width, of the panoramas in pixels."""
    size = min(config.width or width, width) ** 2 / 2e6
    on_gpu = config.device == "cuda" or (config.device == "auto" and DRIVER.exists())
    each = size * (_ON_GPU if on_gpu else _ITERATION / cores()) * (1 + min(1.0, config.iterations / _LONG))
    blocks = 2 if config.blocks == "auto" else math.prod(map(int, config.blocks.split("x")))
    return _MEASURING + each * config.iterations * (1 + _OTHERS + _BLOCK * blocks * config.refine)
