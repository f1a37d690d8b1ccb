"""What tasks see of the blocks that they do not train: levels of detail of a model, made block by block.

The model of a large place does not fit into memory, nor do its levels of detail. Its rows are sorted by
blocks in a file, the levels of one block are made at a time, and those of all are in another file.
"""

import math
from collections.abc import Collection, Iterable, Iterator
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from panolog.orchestrator.engine.stages.partitioning import block_labels
from panolog.orchestrator.runs.config import RunConfig
from panolog.partition.array_file import ArrayFile, sorted_runs
from panolog.partition.levels import make_levels
from panolog.scene.gaussians import Gaussians
from panolog.scene.model import Scene
from panolog.scene.ply import ply_exact, read_ply_chunks, read_scene_means, read_sky, write_ply_parts
from panolog.workers.training.initialise import scene_length

# pixels: the renderer's filter, where cubes are 1 to 2 times as far as need be
_LOW_PASS = 1.2 * math.sqrt(0.3)
_ROWS = 2**16  # of a model in memory at a time


class Surroundings:
    """What blocks start from, and shards render, where others are reduced to what cameras can distinguish.

    That depends on the model and the settings alone, so no file of it has to be kept.
    """

    def __init__(
        self, scene: Scene, model: Path, config: RunConfig, width: int, detail: float | None = None
    ) -> None:
        """Makes the levels of detail of all blocks.

        Args: model, the PLY of the whole place, in whose folder the files without names are; width of the
        panoramas; detail in pixels, None = stage2.detail. Raises OSError if the disk is full.
        """
        detail = config.stage2.detail if detail is None else detail
        self._scene, self._sky = scene, read_sky(model)
        self._angle = detail * 2 * math.pi / width
        side, low_pass = self._angle * scene_length(scene), _LOW_PASS / detail
        labels = block_labels(scene, read_scene_means(model), config)
        file = ArrayFile(model.parent)
        made = [
            file.keep(make_levels(block, side, low_pass))
            for block in _blocks(model, labels, config.grid.count)
        ]
        self._levels = [file.load(kept) for kept in made]

    @property
    def sizes(self) -> tuple[int, ...]:
        """(B,) Gaussians of each block."""
        return tuple(levels.own for levels in self._levels)

    def write_seen(self, path: Path, centers: NDArray[np.float64]) -> NDArray[np.int64]:
        """Writes what cameras distinguish of all blocks, and the sky; returns (N - sky,) whose each is.

        Args: centers (K, 3) of the cameras, world units. Raises OSError if the file cannot be written.
        """
        parts = [levels.rows(levels.cut(centers, self._angle)) for levels in self._levels]
        counts = list(map(len, parts))
        count, sky, exact = sum(counts) + len(self._sky), len(self._sky), self._sky.exact
        write_ply_parts(path, [*parts, self._sky], count=count, sky=sky, exact=exact)
        return np.repeat(np.arange(len(parts)), counts)

    def write(self, path: Path, blocks: Collection[int], cameras: Iterable[int]) -> None:
        """Writes what blocks start from: their own Gaussians, and as sky what cameras see of all others.

        Args: cameras, rows of the scene's panoramas. Raises OSError if the file cannot be written.
        """
        centers = self._scene.centers[list(cameras)]
        parts = [self._levels[block].rows(np.arange(self._levels[block].own)) for block in sorted(blocks)]
        scenery = sum(map(len, parts))
        for other, levels in enumerate(self._levels):
            if other not in blocks:
                found = levels.rows(levels.cut(centers, self._angle))
                parts.append(found.with_tensors(found.tensors(), sky=len(found)))  # it does not train
        parts.append(self._sky)
        count = sum(map(len, parts))
        write_ply_parts(path, parts, count=count, sky=count - scenery, exact=self._sky.exact)


def _blocks(model: Path, labels: NDArray[np.int64], count: int) -> Iterator[Gaussians]:
    """The Gaussians of each block, in the order of the model. Args: labels (N - sky,), the block of each."""
    exact = ply_exact(model)
    pieces = (
        {name: tensor.numpy() for name, tensor in piece.tensors().items()}
        for piece in read_ply_chunks(model, _ROWS)
    )
    for block in sorted_runs(model.parent, pieces, labels, count):  # what follows the labels is sky
        tensors = {name: torch.from_numpy(column) for name, column in block.items()}
        yield Gaussians(**tensors, sky=0, exact=exact)
