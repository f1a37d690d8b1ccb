"""From verified pairs to a reconstruction that look-alikes cannot mislead.

The skeleton alone is mapped first. It has no loops, so no look-alike can bend it. All other pairs are then
judged by it: their points must be where they are seen, but for its drift. With those that are, the mapper
starts again, and what its result contradicts is left out.
"""

from dataclasses import dataclass, replace

import numpy as np
import pycolmap
from numpy.typing import NDArray

from panolog.prepare.sfm.consistency.agreement import FEW, Posed, deviations, posed
from panolog.prepare.sfm.consistency.contradictions import Contradiction, find_contradictions
from panolog.prepare.sfm.consistency.evidence import Evidence, Pair, read_evidence
from panolog.prepare.sfm.consistency.motion import Geometries, look_again
from panolog.prepare.sfm.consistency.skeleton import Edge, Skeleton, find_skeleton, hops
from panolog.prepare.sfm.mapping import Mapper, map_pairs
from panolog.prepare.sfm.workspace import Workspace
from panolog.scene.write import StageProgress

_CLOSE = 2.0  # degrees between where points are and where they are seen, for a pair that fits
_DRIFT = 0.05  # degrees more for each panorama on the way between the two
_FARTHEST = 6.0  # degrees at most: a window further on is farther off
_PURE = 0.8  # share of the matches of a pair that fit, for those to count that cannot be judged
_ROUNDS = 2  # of mapping with the pairs that fit

Kept = dict[Edge, NDArray[np.int64]]  # matches (M, 2) of the pairs that are mapped


@dataclass(frozen=True, eq=False)
class Solution:
    """A reconstruction and what it was made of."""

    model: pycolmap.Reconstruction
    contradictions: list[Contradiction]
    evidence: Evidence
    skeleton: Skeleton
    found: Posed
    kept: Kept


def solve(
    work: Workspace,
    size: tuple[int, int],
    mapper: Mapper,
    max_error: float,
    progress: StageProgress,
    places: NDArray[np.float64] | None = None,
) -> Solution | None:
    """The reconstruction of the pairs that agree; None if there is none.

    Args: size, (width, height) of the panoramas; max_error, pixels that an observation may be off; places,
        (K, 3) where panoramas were taken, if that is known, else NaN.
    """
    ids, evidence = work.ids(), read_evidence(work, size)
    geometries = Geometries(work, size, max_error, evidence)
    evidence = look_again(evidence, geometries)
    skeleton = find_skeleton(evidence, places, geometries.motion)
    kept: Kept = {pair.between: pair.matches for pair in evidence.pairs if pair.between in skeleton.core}
    best: Solution | None = None
    for turn in range(_ROUNDS + 1):
        part = write_pairs(work, kept, "pairs.db")
        model = map_pairs(part, mapper if turn else "incremental", max_error, progress)
        if model is None:
            break
        found = posed(model, ids)
        if best is not None and len(found.poses) < len(best.found.poses):
            break
        against = find_contradictions(evidence, skeleton, found, _CLOSE, geometries.motion)
        best = Solution(model, against, evidence, skeleton, found, kept)
        broken = {row for it in against if it.between in skeleton.tree for row in it.between}
        if turn == 0 and broken:  # what bridges them misleads: the tree alone is left there
            core = frozenset(it for it in skeleton.core if it in skeleton.tree or not broken & set(it))
            skeleton = replace(skeleton, core=core)
            kept = {it: matches for it, matches in kept.items() if it in core}
            continue
        again = _agreeing(best, drift=_DRIFT if turn == 0 else 0.0)
        if again.keys() == kept.keys():
            break
        kept = again
    return best


def _agreeing(solution: Solution, drift: float) -> Kept:
    """The tree, pairs that fit the poses and points, and those of the skeleton that cannot be judged."""
    evidence, core = solution.evidence, solution.skeleton.core
    pairs = [pair.between for pair in evidence.pairs] if drift else []
    way = hops(core, len(evidence.rays), pairs, _FARTHEST / max(drift, _DRIFT))
    kept: Kept = {}
    for pair in evidence.pairs:
        bound = min(_CLOSE + drift * way[pair.between], _FARTHEST) if drift else _CLOSE
        matches = _fitting(solution.found, evidence, pair, bound)
        if pair.between in solution.skeleton.tree or (matches is None and pair.between in core):
            kept[pair.between] = pair.matches
        elif matches is not None and len(matches):
            kept[pair.between] = matches
    return kept


def _fitting(found: Posed, evidence: Evidence, pair: Pair, bound: float) -> NDArray[np.int64] | None:
    """The matches (M, 2) of a pair that fit, none where most do not; None if it cannot be judged."""
    off = deviations(found, evidence, pair)
    known = np.isfinite(off)
    if known.sum() < FEW:
        return None
    if np.median(off[known]) > bound:
        return pair.matches[:0]
    fit = known & (off <= max(bound, _CLOSE))
    if fit.sum() >= _PURE * known.sum():
        fit |= ~known
    return pair.matches[fit]


def write_pairs(work: Workspace, kept: Kept, name: str) -> Workspace:
    """The same panoramas and features with these pairs alone, in a database of that name in the folder."""
    part = replace(work, name=name)
    part.database.unlink(missing_ok=True)
    with pycolmap.Database.open(work.database) as all_, pycolmap.Database.open(part.database) as some:
        for camera in all_.read_all_cameras():
            some.write_camera(camera, True)
        for rig in all_.read_all_rigs():
            some.write_rig(rig, True)
        for frame in all_.read_all_frames():
            some.write_frame(frame, True)
        for image in all_.read_all_images():
            some.write_image(image, True)
            some.write_keypoints(image.image_id, all_.read_keypoints(image.image_id))
        ids = work.ids()
        for (one, other), matches in sorted(kept.items()):
            a, b = ids[one], ids[other]
            geometry = all_.read_two_view_geometry(a, b)
            geometry.inlier_matches = matches.astype(np.uint32)
            some.write_two_view_geometry(a, b, geometry)
    return part
