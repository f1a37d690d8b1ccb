"""Which panoramas are matched with each other, and their matches."""

import tempfile
import time
from collections.abc import Sequence
from typing import Literal

import pycolmap

from panolog.prepare.sfm.looks import look_alikes
from panolog.prepare.sfm.workspace import Workspace
from panolog.scene.write import StageProgress

Pairing = Literal["auto", "exhaustive", "sequential"]
FEW = 16  # panoramas up to which each is matched with each: 120 pairs
_NEXT = 3  # neighbours in the order of names
_MANY = 10  # neighbours in an order that is known; then 16, 32, ... further
_LIKELY = 12  # look-alikes of each, anywhere in the order
_NEAR = 24  # neighbours by GPS
_AT_ONCE = 32  # pairs between two reports of progress, doubled while they take less than _REPORT_S
_REPORT_S = 5.0  # COLMAP indexes the features of a panorama again in each call

Pairs = list[tuple[int, int]]  # ids of COLMAP's database, the smaller first


def choose_pairs(
    work: Workspace, pairing: Pairing, progress: StageProgress, near: Sequence[tuple[int, int]] = ()
) -> Pairs:
    """Pairs to match: all of few panoramas; of more, neighbours in order, by GPS and by looks.

    `auto` takes all pairs up to FEW panoramas. GPS is that of EXIF, where at least half of them have it.
    Args: near, rows of panoramas that a trajectory says are near each other.
    """
    few = pairing == "exhaustive" or (pairing == "auto" and len(work.numbers) <= FEW)
    likely = [] if few else look_alikes(work, _LIKELY, progress)
    ids = work.ids()
    with pycolmap.Database.open(work.database) as database:
        if few:
            every = pycolmap.ExhaustivePairGenerator(pycolmap.ExhaustivePairingOptions(), database)
            return _sorted(every.all_pairs())
        sequential = pycolmap.SequentialPairingOptions()
        sequential.overlap = _NEXT if pairing == "auto" else _MANY
        sequential.quadratic_overlap = pairing == "sequential"
        chosen = pycolmap.SequentialPairGenerator(sequential, database).all_pairs()
        chosen += [(ids[a], ids[b]) for a, b in [*near, *likely]]
        if database.num_pose_priors() * 2 >= len(work.numbers):
            spatial = pycolmap.SpatialPairingOptions()
            spatial.max_num_neighbors = _NEAR
            chosen += pycolmap.SpatialPairGenerator(spatial, database).all_pairs()
        return _sorted(chosen)


def match_pairs(work: Workspace, pairs: Pairs, max_error: float, progress: StageProgress) -> None:
    """Matches the pairs and verifies their geometry; pairs that are done already are skipped.

    Args: max_error, pixels between a feature and its epipolar line.
    """
    matching, verification = pycolmap.FeatureMatchingOptions(), pycolmap.TwoViewGeometryOptions()
    matching.use_gpu = False
    verification.ransac.max_error = max_error
    verification.ransac.random_seed = 0
    names = dict(zip(work.ids(), work.numbers, strict=True))
    pairing = pycolmap.ImportedPairingOptions()
    start, count = 0, _AT_ONCE
    while start < len(pairs):
        progress("matches", start, len(pairs))
        begin = time.monotonic()
        with tempfile.NamedTemporaryFile("w", suffix=".txt", dir=work.folder) as file:
            file.writelines(f"{names[a]} {names[b]}\n" for a, b in pairs[start : start + count])
            file.flush()
            pairing.match_list_path = file.name
            pycolmap.match_image_pairs(work.database, matching, pairing, verification)
        start += count
        if time.monotonic() - begin < _REPORT_S:
            count *= 2
    progress("matches", len(pairs), len(pairs))


def best_matches(work: Workspace) -> list[tuple[int, int]]:
    """For each panorama the one with most verified matches, and how many; itself and 0 without any."""
    of_id = {number: row for row, number in enumerate(work.ids())}
    with pycolmap.Database.open(work.database) as database:
        pairs, counts = database.read_two_view_geometry_num_inliers()
    best = [(row, 0) for row in range(len(of_id))]
    for pair, count in zip(pairs, counts, strict=True):
        a, b = (of_id[number] for number in pycolmap.pair_id_to_image_pair(pair))
        for one, other in ((a, b), (b, a)):
            best[one] = max(best[one], (other, int(count)), key=lambda entry: entry[1])
    return best


def _sorted(pairs: Sequence[tuple[int, int]]) -> Pairs:
    return sorted({(min(a, b), max(a, b)) for a, b in pairs if a != b})
