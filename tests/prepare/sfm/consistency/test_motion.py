"""Motions between panoramas: three of them that fit together, and which of two continues a walk."""

from collections.abc import Mapping

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from panolog.prepare.sfm.consistency.agreement import Posed, has_moved
from panolog.prepare.sfm.consistency.evidence import Evidence, Pair
from panolog.prepare.sfm.consistency.motion import Motion, look_again

Array = NDArray[np.float64]


def _motion(turn: float, *steps: tuple[float, float]) -> Motion:
    """Of a camera that turns by degrees about its vertical axis and then has moved by (right, ahead)."""
    rotation = Rotation.from_euler("y", turn, degrees=True).as_matrix()
    step = np.sum(steps, axis=0)
    shift = -rotation @ np.array([step[0], 0.0, step[1]])
    return Motion(rotation, shift / np.linalg.norm(shift))


class Known:
    """Geometries that are known: of each pair by the number of its matches."""

    def __init__(self, motions: Mapping[tuple[tuple[int, int], int], Motion], second: Pair) -> None:
        self._motions, self._second = motions, second

    def motion(self, pair: Pair) -> Motion | None:
        return self._motions.get((pair.between, len(pair.matches)))

    def second(self, pair: Pair, least: float) -> Pair | None:
        is_it = pair.between == self._second.between and len(self._second.matches) >= least
        return self._second if is_it else None


def _pairs(count: int, matches: int) -> tuple[Evidence, NDArray[np.int64]]:
    """A walk of neighbours whose features lie all around."""
    random = np.random.default_rng(0)
    rays = random.normal(size=(400, 3))
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    every = np.repeat(np.arange(400)[:, None], 2, axis=1)
    pairs = tuple(Pair((row, row + 1), every[:matches], 0.9) for row in range(count - 1))
    return Evidence(tuple([rays] * count), pairs), every


@pytest.mark.parametrize("back", [False, True])
def test_of_two_rivals_the_motion_that_continues_is_taken(back: bool) -> None:
    evidence, every = _pairs(5, 220)
    other = Pair((2, 3), every[220:380])
    on, around = _motion(0, (0, 1)), _motion(0, (0, -1))
    motions = {((row, row + 1), 220): on for row in (0, 1, 3)}
    motions |= {((2, 3), 220): around if back else on, ((2, 3), 160): on if back else around}
    found = look_again(evidence, Known(motions, other))
    chosen = {pair.between: pair for pair in found.pairs}
    assert len(chosen[2, 3].matches) == (160 if back else 220)
    assert chosen[2, 3].rivalled
    assert not chosen[1, 2].rivalled


def test_poses_that_do_not_move_as_a_pair_does() -> None:
    motion = _motion(10, (0, 2))
    poses = {0: (np.eye(3), np.zeros(3)), 1: (motion.rotation, 3 * motion.direction)}
    assert has_moved(Posed(poses, {}), (0, 1), motion)
    assert not has_moved(Posed(poses, {}), (0, 1), _motion(10, (0, -2)))
    assert has_moved(Posed(poses, {}), (0, 1), None)
    assert has_moved(Posed(poses, {}), (0, 2), motion)
