"""What a block hands to the merge: its own Gaussians, and only those that are seen (eq. 12)."""

import torch

from panolog.partition.cells import Cell
from panolog.scene.errors import RunError
from panolog.scene.gaussians import Gaussians, logit


def retained(gaussians: Gaussians, cell: Cell, minimum_opacity: float) -> Gaussians:
    """The retained set of a block: in its half-open cell and more opaque than o_min; never sky (eq. 12).

    Args: gaussians of a block after its optimisation; cell of the block; minimum_opacity o_min in [0, 1).
    Raises RunError if a scene Gaussian has a position that is not finite.
    """
    means = gaussians.means[gaussians.scene].detach().cpu().numpy()
    try:
        inside = cell.contains(means)
    except ValueError as error:
        raise RunError(f"block {cell.block} cannot be cut to its cell: {error}") from error
    keep = torch.zeros(len(gaussians), dtype=torch.bool, device=gaussians.means.device)
    keep[gaussians.scene] = torch.from_numpy(inside).to(keep.device)
    # Compared as logits: a sigmoid may round differently in the lanes and the tail of a vector loop.
    return gaussians.select(keep & (gaussians.opacities > logit(minimum_opacity)))
