"""What panoramas that stand close together share where they show one place, and where fronts look alike."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from panolog.prepare.sfm.consistency.closeness import Closeness
from panolog.prepare.sfm.consistency.evidence import Evidence, Pair

FEATURES = 3000
_FRONT = np.arange(FEATURES) < FEATURES // 2  # of the features, which are on one side
_HALF, _EIGHTH = (np.random.default_rng(1).permutation(FEATURES) < part * FEATURES for part in (0.5, 0.125))


def _shows_one_place(shared: NDArray[np.bool_], *, moved: float = 1.0, ground: bool = True) -> bool | None:
    """Judges a pair of panoramas; those that carry the reconstruction share half of what is all around.

    Args: shared, (FEATURES,) which features the pair has matched; moved, the part of its matches that show a
        motion; ground, whether any features are below.
    """
    random = np.random.default_rng(0)
    rays = random.normal(size=(FEATURES, 3))
    rays[:, 0] = np.abs(rays[:, 0]) * np.where(_FRONT, 1, -1)
    rays[:, 1] = rays[:, 1] if ground else -np.abs(rays[:, 1])
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    carrying = [
        Pair(edge, np.repeat(rows[:, None], 2, axis=1), share=0.5)
        for edge, rows in (((0, 1), np.flatnonzero(_HALF)), ((1, 2), np.flatnonzero(~_HALF)))
    ]
    matches = np.repeat(np.flatnonzero(shared)[:, None], 2, axis=1)
    shows = random.random(len(matches)) < moved
    pair = Pair((0, 2), matches, moved=shows, share=float(shows.sum() / FEATURES))
    known = [replace(it, between=(row, row)) for it in carrying for row in range(3)]
    return Closeness(Evidence((rays,) * 3, (*carrying, *known, pair)), carrying).judge(pair)


@pytest.mark.parametrize(
    ("shared", "verdict"),
    [(_HALF, True), (_HALF & _FRONT, False), (_EIGHTH, True), (_EIGHTH & _FRONT, None)],
    ids=["neighbours", "a front", "another light", "a front in another light"],
)
def test_a_front_that_is_shared_as_by_neighbours_is_not_enough(
    shared: NDArray[np.bool_], verdict: bool | None
) -> None:
    assert _shows_one_place(shared) is verdict


@pytest.mark.parametrize(("ground", "verdict"), [(True, True), (False, False)])
def test_few_matches_that_show_a_motion_tell_something_in_a_bare_place_alone(
    ground: bool, verdict: bool
) -> None:
    """The closer two panoramas stand, the fewer there are."""
    assert _shows_one_place(_HALF, moved=0.2, ground=ground) is verdict
