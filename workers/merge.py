"""The end of a run: all blocks and the sky become one PLY, without ever being in memory together (eq. 13)."""

from collections.abc import Iterator, Sequence
from pathlib import Path

from panolog.scene.errors import RunError
from panolog.scene.gaussians import Gaussians
from panolog.scene.ply import ply_header, read_ply_chunks, write_ply


def merge(blocks: Sequence[Path], sky: Gaussians, output: Path) -> int:
    """Writes the merged model, blocks in the order given and the sky of Stage I last (eq. 13), atomically.

    Cells do not overlap (eq. 12), so the union is a concatenation. Memory stays constant in the blocks' size.

    Args: blocks, the PLY of each block, already cut and without sky; sky, Gaussians that are all sky.
    Returns the number of Gaussians in `output`. Raises RunError if a block has sky or counts do not add up,
    ValueError if `sky` holds scene Gaussians, InputError if a PLY is damaged, OSError if writing fails.
    """
    if sky.sky != len(sky):
        raise ValueError(f"{len(sky) - sky.sky} of the {len(sky)} Gaussians given as sky are not sky")
    headers = [ply_header(path) for path in blocks]
    for path, (_, block_sky) in zip(blocks, headers, strict=True):
        if block_sky:
            raise RunError(f"{path} has {block_sky} sky Gaussians; a block must be cut before the merge")
    count = sum(block for block, _ in headers) + len(sky)
    write_ply(output, _parts(blocks, sky), count=count, sky=len(sky))
    if ply_header(output) != (count, len(sky)):
        raise RunError(
            f"{output} does not hold the {count} Gaussians of its {len(blocks)} blocks and the sky"
        )
    return count


def _parts(blocks: Sequence[Path], sky: Gaussians) -> Iterator[Gaussians]:
    for path in blocks:
        yield from read_ply_chunks(path)
    yield sky
