"""What a camera sees before, among and behind own splats, on CUDA: as csrc/bake.cpp finds it.

The lists of pairs of splats and tiles are chosen by torch's operations, for none of which the host waits.
"""

import torch
from torch import Tensor
from torch.nn.functional import max_pool2d

from panolog.renderer.cuda.parts import THREADS, TILE, Launch, Pairs, Projected, composite, of_tiles, tiles_of

UNSEEN = 1 / 255  # kUnseen in csrc/bake.cpp
WEIGHT_UNITS = 2**22  # kWeightUnits in csrc/cuda/composite.cu


def surroundings(
    launch: Launch,
    projected: Projected,
    pairs: Pairs,
    width: int,
    height: int,
    own: int,
    slack: float,
    faint: float,
) -> tuple[Tensor, ...]:
    """Two layers, spans and `among` of `ops.bake`, of N splats of which the first `own` are not frozen."""
    splats, rays, _, depth, _ = projected
    entries = pairs.entries.long()
    tile = torch.repeat_interleave(pairs.starts.diff().long(), output_size=len(entries))
    distance = depth[entries]
    spans = _widened(_spans(distance, entries < own, tile, tiles_of(width, height)), slack)
    first, last = spans[:, 0][tile], spans[:, 1][tile]
    before = _chosen(pairs, (distance < first) & (first <= last))
    front = composite(launch, splats, rays, before, width, height)
    seen = max_pool2d(1 - front[1][None], TILE, ceil_mode=True).flatten() >= UNSEEN
    spans[:, 0].masked_fill_(~seen, torch.inf)
    weights = weights_of(launch, projected, pairs, width, height, spans)
    frozen, beyond = (entries >= own) & (distance >= spans[:, 0][tile]), distance > last
    met = frozen & ~beyond & (weights > faint * WEIGHT_UNITS)
    among = depth.new_zeros(len(depth) + 1, dtype=torch.uint8)  # the last one: of no splat
    among = among.scatter_(0, torch.where(met, entries, len(depth)), 1)[:-1]
    behind = _chosen(pairs, frozen & (beyond | (among[entries] == 0)))
    back = composite(launch, splats, rays, behind, width, height)
    return *front, *back, spans, among


def weights_of(
    launch: Launch, projected: Projected, pairs: Pairs, width: int, height: int, spans: Tensor
) -> Tensor:
    """(E,) int32 sums of weights times `WEIGHT_UNITS`: of each pair those of the splat in the tile's pixels.

    Args: spans (T, 2); where the first value is above the second, the weights of the tile are 0.
    """
    weights = torch.zeros_like(pairs.entries)
    splats, rays, *_ = projected
    launch(
        "composite_weights" if rays is None else "composite_ray_weights",
        tiles_of(width, height),
        THREADS,
        **of_tiles(splats, rays, pairs.entries, pairs.starts, width, height),
        spans=spans,
        weights=weights,
    )
    return weights


def _spans(distance: Tensor, own: Tensor, tile: Tensor, size: tuple[int, int]) -> Tensor:
    """(2, down, across) the distances of own splats of each tile: minus the least, and the largest.

    Args: distance (E,), own (E,) bool and tile (E,) int64 of pairs; size, tiles across and down.
    """
    least, most = torch.where(own, distance, torch.inf), torch.where(own, distance, 0)
    first = distance.new_full((size[0] * size[1],), torch.inf).scatter_reduce_(0, tile, least, "amin")
    last = torch.zeros_like(first).scatter_reduce_(0, tile, most, "amax")
    return torch.stack([-first, last]).view(2, size[1], size[0])


def _widened(spans: Tensor, slack: float) -> Tensor:
    """(T, 2) what `_spans` finds in each tile and its neighbours, around the cylinder, longer by `slack`."""
    around = torch.cat([spans[..., -1:], spans, spans[..., :1]], 2)
    first, last = max_pool2d(around, 3, 1, padding=(1, 0)).flatten(1)
    return torch.stack([-first * (1 - slack), last * (1 + slack)], 1)


def _chosen(pairs: Pairs, which: Tensor) -> Pairs:
    """The pairs for which `which` (E,) is true, in memory for all E: the host does not know their number."""
    ends = which.cumsum(0)
    places = torch.where(which, ends - 1, len(which))
    entries = pairs.entries.new_zeros(len(which) + 1).scatter_(0, places, pairs.entries)
    starts = torch.cat([ends.new_zeros(1), ends])[pairs.starts.long()]
    return Pairs(entries, starts.int(), ends)
