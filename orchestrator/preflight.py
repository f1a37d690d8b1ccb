"""What a job will need, before it starts: a rough estimate with its formula, and the refusals that follow.

Gaussians: Stage I grows the sparse cloud about `GROWTH`-fold (3DGS on outdoor scenes: five to twenty), up to
`densify.max_gaussians`; the sky comes on top. Each Gaussian has 59 floats of 4 bytes. Training keeps of each
float its value, gradient and two moments of Adam, and about as many bytes again go through the rasterizer.
A checkpoint holds values and moments, a PLY 62 floats. Panoramas stay decoded within `cache.memory`; a step
works on some twenty float images of the training size.
"""

import shutil
from dataclasses import dataclass
from pathlib import Path

from panolog.orchestrator.config import RunConfig
from panolog.scene.errors import InputError
from panolog.scene.model import Scene

GROWTH = 5
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


def estimate(points: int, panoramas: int, width: int, config: RunConfig) -> Needs:
    """What a job with a sparse cloud of `points` and `panoramas` trained at `width` pixels needs."""
    grown = points * GROWTH
    if config.densify.max_gaussians:
        grown = min(grown, max(points, config.densify.max_gaussians))
    gaussians = grown + config.sky.count
    blocks = config.grid.count if config.refine else 0
    # Every block has its checkpoint until it ends; one more is written beside the one it replaces.
    checkpoints = (max(1, blocks) + 1) * gaussians * _CHECKPOINT
    models = (1 + (1 if blocks else 0) + 1) * gaussians * _PLY  # Stage I, the blocks together, the merge
    return Needs(gaussians, task_memory(gaussians, panoramas, width, config), checkpoints + models)


def task_memory(gaussians: int, panoramas: int, width: int, config: RunConfig) -> int:
    """Bytes of memory, roughly, of one task that trains so many Gaussians."""
    pixels = width * (width // 2)
    cache = min(int(config.cache.memory * 2**30), panoramas * pixels * 4)
    return _PROCESS + gaussians * _STATE * 5 + cache + pixels * _IMAGES


def estimate_scene(scene: Scene, config: RunConfig) -> Needs:
    """`estimate` for a scene, at the width that the run uses."""
    return estimate(len(scene.points), len(scene.train), config.width or scene.width, config)


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


def gib(size: float) -> str:
    """Bytes for people."""
    return f"{size / 2**30:.1f} GiB" if size >= 2**30 / 10 else f"{size / 2**20:.0f} MiB"
