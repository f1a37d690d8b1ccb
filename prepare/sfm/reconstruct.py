"""From panoramas to poses and points: features, matches, mapping, each of which can be interrupted."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from panolog.prepare.panorama_files import PanoramaFile
from panolog.prepare.sfm.consistency.contradictions import Contradiction
from panolog.prepare.sfm.consistency.solve import Solver
from panolog.prepare.sfm.features import MEMORY, find_features
from panolog.prepare.sfm.links import Link
from panolog.prepare.sfm.mapping import Mapper
from panolog.prepare.sfm.pairs import Pairing, best_matches, choose_pairs, match_pairs
from panolog.prepare.sfm.sketch import Sketcher
from panolog.prepare.sfm.sparse_model import SparseModel
from panolog.prepare.sfm.trajectory import near_pairs
from panolog.prepare.sfm.workspace import Workspace, file_state, silence_colmap
from panolog.scene.errors import SceneError
from panolog.scene.image_files import check_images
from panolog.scene.read import MASKS, SKY_MASKS
from panolog.scene.write import StageProgress

_VERSION = 2  # of features and matches: those of another version are not used
_NEAREST = 12  # panoramas that each is matched with where a trajectory says how far they are
_LEAST = 8  # panoramas of a part, or most of them: fewer agree by chance where all is alike
FIRM = 20  # points seen by three panoramas: two also see points from false matches


@dataclass(frozen=True, eq=False)
class Reconstruction:
    """Poses and points of panoramas, or of a part of them, and how they came about."""

    panoramas: tuple[PanoramaFile, ...]  # all, in order
    size: tuple[int, int]  # width and height of each
    model: SparseModel
    links: list[Link]  # between parts of it, the weakest first; their rows are those of `from_colmap`
    contradictions: list[Contradiction]  # in it, and between it and what was left out for them
    missing: dict[int, tuple[int, int]]  # rows without a pose: the row with most matches, and how many
    unconfirmed: frozenset[int]  # those of them that a single pair held
    others: list[tuple[int, ...]]  # rows of the other parts, each right, but not connected to this one
    features: int
    pairs: int


def max_error(width: int) -> float:
    """Pixels between an observation and its point, at most: COLMAP's 4, but no more than 0.7 degrees."""
    return min(4.0, width / 512)


def reconstruct(
    panoramas: Sequence[PanoramaFile],
    folder: Path,
    *,
    pairing: Pairing,
    mapper: Mapper,
    partial: bool,
    progress: StageProgress,
    places: NDArray[np.float64] | None = None,
    memory: int = MEMORY,
    sketcher: Sketcher | None = None,
) -> list[Reconstruction]:
    """Features, matches, poses and points of `panoramas`. Results are kept in `folder`, for the next call.

    Args: partial, accept parts of which none has more than half of them; memory, bytes that may be used;
        places, (K, 3) where they were taken, by a known trajectory, NaN where it is not; sketcher of poses.
    Returns: the parts that are each without a contradiction, the largest first.
    Raises: SceneError, a file is damaged or of another size, or the panoramas share too little.
    """
    with silence_colmap():
        work = Workspace(folder, tuple(panoramas), sketcher=sketcher)
        size, features = featured(work, progress, memory)
        allowed = max_error(size[0])
        pairs = choose_pairs(work, pairing, progress, [] if places is None else near_pairs(places, _NEAREST))
        match_pairs(work, pairs, allowed, progress)
        solver = Solver(work, size, mapper, allowed, progress, places)
        least = min(len(panoramas), max(3, min(_LEAST, len(panoramas) // 2 + 1)))
        solved = solver.parts(least, doubtful=partial)
    firm = [part for part in solved if part.sparse.points_seen_by(min(3, len(panoramas))) >= FIRM]
    models = [part.sparse for part in firm]
    shared = best_matches(work)
    if not models or not (partial or 2 * len(models[0].rows) > len(panoramas)):
        raise SceneError(_refusal(work, models, shared, solver.cuts))
    against = [*solver.cuts, *(it for part in solved for it in part.contradictions)]
    return [
        Reconstruction(
            panoramas=tuple(panoramas),
            size=size,
            model=model,
            links=part.links,
            contradictions=[it for it in against if set(it.between) & set(model.rows)],
            missing={row: shared[row] for row in range(len(panoramas)) if row not in model.rows},
            unconfirmed=frozenset(solver.unconfirmed.difference(model.rows)),
            others=[other.rows for other in models if other is not model],
            features=features,
            pairs=len(pairs),
        )
        for part, model in zip(firm, models, strict=True)
    ]


def featured(work: Workspace, progress: StageProgress, memory: int) -> tuple[tuple[int, int], int]:
    """The width and height of the panoramas of a workspace, and how many features it then has of them.

    Raises SceneError as `reconstruct` does.
    """
    size = check_images([panorama.path for panorama in work.panoramas])
    masks = [
        [panorama.layers[layer] for layer in (MASKS, SKY_MASKS) if layer in panorama.layers]
        for panorama in work.panoramas
    ]
    states = [[(str(path), *file_state(path)) for path in paths] for paths in masks]
    work.open([_VERSION, max_error(size[0]), states])
    features = find_features(work, masks, progress, memory)
    if features == 0:
        where = work.panoramas[0].path.parent
        raise SceneError(f"{where}: no features in any panorama; are they masked, or empty?")
    return size, features


def _refusal(
    work: Workspace,
    found: Sequence[SparseModel],
    shared: Sequence[tuple[int, int]],
    cuts: Sequence[Contradiction],
) -> str:
    """One line: which panoramas have no pose, and what to do."""
    names = [panorama.name for panorama in work.panoramas]
    best = max(range(len(names)), key=lambda row: shared[row][1])
    other, count = shared[best]
    pair = (
        f"{names[best]} and {names[other]} share most, {count} features" if count else "no two share features"
    )
    if not found and cuts:
        worst = max(cuts, key=lambda it: it.matches - it.points)
        first, second = (names[row] for row in worst.between)
        return (
            f"{work.panoramas[0].path.parent}: the poses contradict the matches of {len(cuts)} pairs, most "
            f"of all {first} and {second}, which {worst.reason}, as where windows repeat; name the "
            "panoramas in the order of the walk, take more between these, or accept parts with --partial"
        )
    if not found:
        return (
            f"{work.panoramas[0].path.parent}: the {len(names)} panoramas could not be connected ({pair}); "
            "take them closer to each other, or leave out those of other places (features are kept in "
            f"{work.folder})"
        )
    lost = [name for row, name in enumerate(names) if row not in found[0].rows]
    more = f" and {len(lost) - 3} more" if len(lost) > 3 else ""
    parts = ", ".join(str(len(model.rows)) for model in found)
    return (
        f"{work.panoramas[0].path.parent}: of {len(names)} panoramas only {parts} were connected, the first "
        f"without {', '.join(lost[:3])}{more}; take more between them, or accept these parts with --partial"
    )
