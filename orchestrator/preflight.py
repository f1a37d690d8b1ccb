"""What a job will need, before it starts: a rough estimate with its formula, and the refusals that follow.

Gaussians: a dense sparse cloud grows with its points, a thin one until it fills the pictures. Measured at
1024x512 and 1,500 iterations: a street (19,900 points, 56 panoramas) doubled, an indoor scene (3,850 points,
9 panoramas) grew 22-fold, to a sixth of one panorama's pixels; a block doubled once more in Stage II. Longer
runs densify more often (3DGS on outdoor scenes: five-fold and more), hence `_GROWTH` and `_FILLED`. All of it
is capped by `densify.max_gaussians`; the sky comes on top.

Each Gaussian has 59 floats of 4 bytes. Training keeps of each float its value, gradient and two moments of
Adam, and about as many bytes again go through the rasterizer. A checkpoint holds values and moments, a PLY 62
floats. Panoramas stay decoded within `cache.memory`; a step works on some twenty float images of the training
size.
"""

import shutil
from dataclasses import dataclass
from pathlib import Path

from panolog.orchestrator.config import RunConfig
from panolog.orchestrator.machine import cores
from panolog.orchestrator.units import gib
from panolog.scene.errors import InputError
from panolog.scene.model import Scene

_GROWTH = 5  # Gaussians after Stage I for each sparse point
_FILLED = 1 / 6  # Gaussians after Stage I for each pixel of one panorama, if that is more
BLOCK_GROWTH = 2  # Gaussians of a block for each of Stage I
_STATE = 59 * 4  # bytes of one Gaussian's parameters
_CHECKPOINT = 3 * _STATE + 16  # with both moments and the densification statistics
_PLY = 62 * 4
_PROCESS = 700 * 2**20  # bytes of a worker that has imported torch
_IMAGES = 20 * 3 * 4  # bytes of one pixel of a training step


@dataclass(frozen=True)
class Needs:
    """Bytes, roughly."""

    gaussians: int  # of Stage I, sky included
    task: int  # memory of one training task: RAM on the CPU, most of it GPU memory on CUDA
    disk: int  # of the run folder at its fullest


def estimate(points: int, decoded: int, width: int, config: RunConfig, together: int) -> Needs:
    """What a job with a sparse cloud of `points`, trained at `width` pixels, needs.

    Args: decoded, bytes of all training panoramas; together, how many tasks may run at once.
    """

    def capped(grown: float) -> int:
        most = max(points, config.densify.max_gaussians) if config.densify.max_gaussians else grown
        return int(min(grown, most))

    coarse = max(points * _GROWTH, width * (width // 2) * _FILLED)
    gaussians = capped(coarse) + config.sky.count
    blocks = config.grid.count if config.refine else 0
    largest = capped(coarse * BLOCK_GROWTH) + config.sky.count if blocks else gaussians
    # A task has a checkpoint while it runs; one more is written beside the one it replaces.
    checkpoints = (max(1, min(blocks, together)) + 1) * largest * _CHECKPOINT
    models = (gaussians + 2 * largest if blocks else 2 * gaussians) * _PLY  # Stage I, all blocks, the merge
    return Needs(gaussians, task_memory(largest, decoded, width, config), checkpoints + models)


def task_memory(gaussians: int, decoded: int, width: int, config: RunConfig) -> int:
    """Bytes of memory, roughly, of one task that trains so many Gaussians on `decoded` bytes of panoramas."""
    cache = min(int(config.cache.memory * 2**30), decoded)
    return _PROCESS + gaussians * _STATE * 5 + cache + width * (width // 2) * _IMAGES


def estimate_scene(scene: Scene, config: RunConfig, *, local: bool = True) -> Needs:
    """`estimate` for a scene at the run's width, on this machine or, if not `local`, on a large cluster."""
    width = config.width or scene.width
    together = cores() if local else config.grid.count
    return estimate(len(scene.points), decoded_bytes(scene, width), width, config, together)


def decoded_bytes(scene: Scene, width: int) -> int:
    """Bytes of all training panoramas as the cache keeps them."""
    from panolog.scene.images import view_bytes  # noqa: PLC0415  # imports torch, for which `status` has no time

    return sum(view_bytes(scene.panoramas[row], width) for row in scene.train)


def check_disk(root: Path, needs: Needs) -> None:
    """Raises InputError if the disk of the (perhaps future) folder `root` cannot hold the run."""
    place = next(folder for folder in (root.absolute(), *root.absolute().parents) if folder.exists())
    free = shutil.disk_usage(place).free
    if free < needs.disk:
        raise InputError(
            f"{root}: checkpoints and models of about {needs.gaussians:,} Gaussians need {gib(needs.disk)},"
            f" {gib(free)} of its disk are free; make room, take another disk, or cap densify.max_gaussians"
        )


def fitting(task: int, available: int) -> int:
    """How many tasks of so many bytes fit into `available` bytes of memory, at least one."""
    return max(1, int(available * 0.9) // task)
