"""The merge of blocks: what each block contributes (eq. 12), and the union with the sky (eq. 13)."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from panolog.partition.cells import Volume
from panolog.scene.errors import RunError
from panolog.scene.gaussians import Gaussians, logit
from panolog.scene.ply import join_ply, ply_exact, ply_header, ply_offset


def retained(gaussians: Gaussians, cell: Volume, minimum_opacity: float) -> Gaussians:
    """The retained set of a block (eq. 12). Args and errors as of `retains`."""
    return gaussians.select(retains(gaussians, cell, minimum_opacity))


def retains(gaussians: Gaussians, cell: Volume, minimum_opacity: float) -> torch.Tensor:
    """(N,) what a block retains: in its half-open cell and more opaque than o_min; never sky (eq. 12).

    Args: gaussians of a block after its optimisation; cell of the block, or a region that is trained once
    more; minimum_opacity o_min in [0, 1).
    Raises RunError if a scene Gaussian has a position that is not finite.
    """
    means = gaussians.means[gaussians.scene].detach().cpu().numpy()
    try:
        inside = cell.contains(means)
    except ValueError as error:
        raise RunError(f"{cell} cannot be cut out: {error}") from error
    keep = torch.zeros(len(gaussians), dtype=torch.bool, device=gaussians.means.device)
    keep[gaussians.scene] = torch.from_numpy(inside).to(keep.device)
    # Compared as logits: a sigmoid may round differently in the lanes and the tail of a vector loop.
    return keep & (gaussians.opacities > logit(minimum_opacity))


def merge(blocks: Mapping[Path, NDArray[np.bool_] | None], coarse: Path, output: Path) -> int:
    """Writes the merged model, blocks in the order given and the sky of Stage I last (eq. 13), atomically.

    Cells do not overlap (eq. 12), so the union is a concatenation, and Stage II leaves the sky as it is: rows
    are copied as they stand in the files.

    Args: blocks, the PLY of each block, already cut and without sky, and (N,) which of its rows to take, None
    = all; coarse, the PLY of the Stage I model.
    Returns the number of Gaussians in `output`. Raises RunError if a block has sky, InputError if a PLY is
    damaged, OSError if reading or writing fails.
    """
    parts: list[tuple[Path, range | NDArray[np.bool_]]] = []
    for path, rows in blocks.items():
        count, block_sky = ply_header(path)
        if block_sky:
            raise RunError(f"{path} has {block_sky} sky Gaussians; a block must be cut before the merge")
        parts.append((path, range(count) if rows is None else rows))
    count, sky = ply_header(coarse)
    parts.append((coarse, range(count - sky, count)))
    return join_ply(output, parts, sky=sky, offset=ply_offset(coarse), exact=ply_exact(coarse))
