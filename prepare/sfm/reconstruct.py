"""From panoramas to poses and points: features, matches, mapping, each of which can be interrupted."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from panolog.prepare.panorama_files import PanoramaFile
from panolog.prepare.sfm.consistency.contradictions import (
    Contradiction,
    consistent_part,
    is_repetitive,
    is_trusted,
)
from panolog.prepare.sfm.consistency.solve import Solution, solve
from panolog.prepare.sfm.features import MEMORY, find_features
from panolog.prepare.sfm.links import Link, find_links
from panolog.prepare.sfm.mapping import Mapper
from panolog.prepare.sfm.pairs import Pairing, best_matches, choose_pairs, match_pairs
from panolog.prepare.sfm.sparse_model import SparseModel, from_colmap
from panolog.prepare.sfm.trajectory import near_pairs
from panolog.prepare.sfm.workspace import Workspace, file_state, silence_colmap
from panolog.scene.errors import SceneError
from panolog.scene.image_files import check_images
from panolog.scene.read import MASKS, SKY_MASKS
from panolog.scene.write import StageProgress

_VERSION = 2  # of features and matches: those of another version are not used
_NEAREST = 12  # panoramas that each is matched with where a trajectory says how far they are
FIRM = 20  # points seen by three panoramas: two also see points from false matches

LayerFiles = dict[str, list[Path | None]]  # by the name of the layer, for each picture


@dataclass(frozen=True, eq=False)
class Reconstruction:
    """Poses and points of panoramas, and how they came about."""

    panoramas: tuple[PanoramaFile, ...]  # all, in order
    layers: LayerFiles
    size: tuple[int, int]  # width and height of each
    model: SparseModel
    links: list[Link]  # between parts of it, the weakest first; their rows are those of `from_colmap`
    contradictions: list[Contradiction]
    missing: dict[int, tuple[int, int]]  # rows without a pose: the row with most matches, and how many
    features: int
    pairs: int


def max_error(width: int) -> float:
    """Pixels between an observation and its point, at most: COLMAP's 4, but no more than 0.7 degrees."""
    return min(4.0, width / 512)


def reconstruct(
    panoramas: Sequence[PanoramaFile],
    layers: LayerFiles,
    folder: Path,
    *,
    pairing: Pairing,
    mapper: Mapper,
    partial: bool,
    progress: StageProgress,
    places: NDArray[np.float64] | None = None,
    memory: int = MEMORY,
) -> Reconstruction:
    """Features, matches, poses and points of `panoramas`. Results are kept in `folder`, for the next call.

    Args: partial, accept poses for half of them or fewer, and the consistent part of contradictory ones;
        memory, bytes that may be used;
        places, (K, 3) where they were taken, by a known trajectory, NaN where it is not.
    Raises: SceneError, a file is damaged or of another size, the panoramas share too little, or their poses
        contradict their matches.
    """
    size = check_images([panorama.path for panorama in panoramas])
    names = [panorama.name for panorama in panoramas]
    work = Workspace(folder, tuple(panoramas))
    masks = [
        [path for layer in (MASKS, SKY_MASKS) if (path := layers.get(layer, [None] * len(names))[row])]
        for row in range(len(names))
    ]
    allowed = max_error(size[0])
    work.open([_VERSION, allowed, [[(str(path), *file_state(path)) for path in paths] for paths in masks]])
    with silence_colmap():
        features = find_features(work, masks, progress, memory)
        if features == 0:
            where = panoramas[0].path.parent
            raise SceneError(f"{where}: no features in any panorama; are they masked, or empty?")
        near = near_pairs(places, _NEAREST) if places is not None else []
        pairs = choose_pairs(work, pairing, progress, near)
        match_pairs(work, pairs, allowed, progress)
        solved = solve(work, size, mapper, allowed, progress, places)
    found = from_colmap(solved.model, work.numbers, size) if solved is not None else None
    shared = best_matches(work)
    if solved is None or found is None or not _is_sound(found, len(panoramas), partial):
        raise SceneError(_refusal(work, found, shared))
    agreed = consistent_part(found.rows, solved.contradictions, solved.skeleton, solved.evidence)
    if not is_trusted(solved.contradictions, solved.skeleton, found.rows):
        if not partial:
            raise SceneError(_doubt(work, solved, found.rows, len(agreed)))
        found = found.part(agreed)
    sigma = float(np.median(np.concatenate(found.errors(size[0])))) * 2 * np.pi / size[0]
    seen = [rows for rows, _ in found.sightings]
    return Reconstruction(
        panoramas=tuple(panoramas),
        layers=layers,
        size=size,
        model=found,
        links=find_links(found.centers, found.points, seen, sigma),
        contradictions=[it for it in solved.contradictions if set(it.between) <= set(found.rows)],
        missing={row: shared[row] for row in range(len(names)) if row not in found.rows},
        features=features,
        pairs=len(pairs),
    )


def _is_sound(found: SparseModel, panoramas: int, partial: bool) -> bool:
    """Whether there are enough firm points, and poses of most panoramas."""
    return found.points_seen_by(min(3, panoramas)) >= FIRM and (partial or 2 * len(found.rows) > panoramas)


def _doubt(work: Workspace, solved: Solution, rows: Sequence[int], agreed: int) -> str:
    """One line: which panoramas contradict each other or may have moved in two ways, and what to do."""
    names, folder = [panorama.name for panorama in work.panoramas], work.panoramas[0].path.parent
    if is_repetitive(solved.skeleton, rows):
        rivalled = [edge for edge in sorted(solved.skeleton.rivalled) if set(edge) <= set(rows)]
        one, other = (names[row] for row in rivalled[0])
        return (
            f"{folder}: {len(rivalled)} pairs of neighbours, first {one} and {other}, fit two motions of the "
            "camera about equally well, as where everything repeats; take panoramas closer to each other, "
            "say where they were taken with --trajectory, or accept the "
            f"{agreed} of {len(names)} that agree with --partial"
        )
    contradictions = solved.contradictions
    worst = contradictions[0]
    one, other = (names[row] for row in worst.between)
    return (
        f"{folder}: the poses contradict the matches of {len(contradictions)} pairs, "
        f"most of all {one} and {other} ({worst.points} of {worst.matches} points fit), as where "
        "windows repeat; "
        "name the panoramas in the order of the walk or take more between these, or accept the "
        f"{agreed} of {len(names)} that agree with --partial"
    )


def _refusal(work: Workspace, found: SparseModel | None, shared: Sequence[tuple[int, int]]) -> str:
    """One line: which panoramas have no pose, and what to do."""
    names = [panorama.name for panorama in work.panoramas]
    best = max(range(len(names)), key=lambda row: shared[row][1])
    other, count = shared[best]
    pair = (
        f"{names[best]} and {names[other]} share most, {count} features" if count else "no two share features"
    )
    if found is None or len(found.rows) <= 2:
        return (
            f"{work.panoramas[0].path.parent}: the {len(names)} panoramas could not be connected ({pair}); "
            "take them closer to each other, or leave out those of other places (features are kept in "
            f"{work.folder})"
        )
    lost = [name for row, name in enumerate(names) if row not in found.rows]
    more = f" and {len(lost) - 3} more" if len(lost) > 3 else ""
    return (
        f"{work.panoramas[0].path.parent}: only {len(found.rows)} of {len(names)} panoramas were connected, "
        f"not {', '.join(lost[:3])}{more}; take more between them, or accept a partial reconstruction with "
        "--partial"
    )
