"""The end of a run: all blocks and the sky become one PLY, without ever being in memory (eq. 13)."""

from collections.abc import Sequence
from pathlib import Path

from panolog.scene.errors import RunError
from panolog.scene.ply import join_ply, ply_header


def merge(blocks: Sequence[Path], coarse: Path, output: Path) -> int:
    """Writes the merged model, blocks in the order given and the sky of Stage I last (eq. 13), atomically.

    Cells do not overlap (eq. 12), so the union is a concatenation, and Stage II leaves the sky as it is: rows
    are copied as they stand in the files.

    Args: blocks, the PLY of each block, already cut and without sky; coarse, the PLY of the Stage I model.
    Returns the number of Gaussians in `output`. Raises RunError if a block has sky, InputError if a PLY is
    damaged, OSError if reading or writing fails.
    """
    parts = []
    for path in blocks:
        count, block_sky = ply_header(path)
        if block_sky:
            raise RunError(f"{path} has {block_sky} sky Gaussians; a block must be cut before the merge")
        parts.append((path, range(count)))
    count, sky = ply_header(coarse)
    parts.append((coarse, range(count - sky, count)))
    join_ply(output, parts, sky=sky)
    return sum(len(rows) for _, rows in parts)
