"""Walks around a square whose sides look alike: `python -m tests.prepare.sfm.consistency.sweep`.

A rule of `consistency` that helps one walk may ruin another: a change of one is judged by how many walks are
whole, in parts, refused and wrong. With `--streets` they are along all streets of a grid, with long loops.
"""

import argparse
import tempfile
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from panolog.prepare.sfm.consistency.solution import Solution
from tests.prepare.sfm.accuracy import drift
from tests.prepare.sfm.consistency.simulated import Place, parts_of, square
from tests.prepare.sfm.consistency.streets import Grid, town

_RIGHT = 0.1  # metres rms, where the next side of the square is 12 off
_RIGHT_IN_STREETS = 1.0  # metres rms, where the next street is 56 off
_SHORTEST = 3  # panoramas of a walk between two jumps


@dataclass(frozen=True)
class Walk:
    """A way around the square: places in the order in which they are photographed."""

    count: int  # places around the square
    jumps: int = 0  # where the next place is another one, often one that looks alike
    gap: int = 0  # places that are missing on both sides of a jump
    points: float = 1.0  # of as many as usual
    ground: float = 1.0  # of as many points of the ground as usual: with few, look-alikes share as neighbours
    shuffled: bool = False
    seed: int = 0

    @property
    def order(self) -> NDArray[np.int64]:
        """(K,) the places, by a jump across the square, then by others at random."""
        random, half = np.random.default_rng(self.seed), self.count // 2
        walk = np.arange(self.count)
        if self.jumps:
            end = int(random.integers(_SHORTEST, half - _SHORTEST + 1))
            back = np.arange(min(end + half, self.count) - 1, end - 1 + self.gap, -1)
            walk = np.concatenate([walk[:end], back, walk[end + half + self.gap :]])
        for _ in range(self.jumps - 1):
            cut = int(random.integers(_SHORTEST, len(walk) - _SHORTEST))
            walk = np.concatenate([walk[:cut], walk[cut:][::-1]])
        return random.permutation(walk) if self.shuffled else walk

    def outcome(self, folder: Path) -> str:
        """One of "whole", "parts", "refused" and "WRONG"."""
        place = square(folder, count=self.count, order=self.order, points=self.points, ground=self.ground)
        return _outcome(place, _RIGHT)


@dataclass(frozen=True)
class Streets(Grid):
    """A walk along all streets of a grid."""

    def outcome(self, folder: Path) -> str:
        """One of "whole", "parts", "refused" and "WRONG"."""
        return _outcome(town(folder, self), _RIGHT_IN_STREETS)


def _outcome(place: Place, right: float) -> str:
    parts = parts_of(place)
    if not parts:
        return "refused"
    if any(off(part, place.centers) > right for part in parts):
        return "WRONG"
    return "whole" if len(parts[0].found.poses) == len(place.centers) else "parts"


def streets() -> Iterator[Streets]:
    """Walks of 76 and of 168 panoramas, with copies among the houses and without."""
    for seed in range(3):
        for streets_each_way in (2, 3):
            for copies in (0.0, 0.15):
                yield Streets(streets_each_way, streets_each_way, copies, seed=seed)


def walks() -> Iterator[Walk]:
    """The walks of the sweep, for each seed."""
    for seed in range(4):
        for points, ground in ((1.0, 1.0), (0.5, 1.0), (1.0, 0.5)):
            for count in (16, 24):
                for jumps in (1, 2, 3):
                    yield Walk(count, jumps, points=points, ground=ground, seed=seed)
                yield Walk(count, points=points, ground=ground, shuffled=True, seed=seed)
                yield Walk(count, 1, gap=2, points=points, ground=ground, seed=seed)
        yield Walk(16, 1, gap=2, shuffled=True, seed=seed)


def off(part: Solution, centers: NDArray[np.float64]) -> float:
    """Metres rms between the places of a part and the true ones, centers (K, 3) of all panoramas."""
    return drift(part.sparse.centers, centers[list(part.sparse.rows)])


def main() -> None:
    """Prints the outcome of each walk, and how many have each."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--every", type=int, default=1, help="of so many walks one")
    parser.add_argument("--streets", action="store_true")
    options, outcomes = parser.parse_args(), Counter[str]()
    chosen: list[Streets | Walk] = [*streets()] if options.streets else [*walks()]
    for walk in chosen[:: options.every]:
        with tempfile.TemporaryDirectory() as folder:
            outcome = walk.outcome(Path(folder))
        outcomes[outcome] += 1
        print(outcome, walk, flush=True)
    print(*(f"{count} {outcome}" for outcome, count in sorted(outcomes.items())), sep=", ")


if __name__ == "__main__":
    main()
