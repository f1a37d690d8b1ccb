"""Which pairs of a walk contradict its poses, where copies of houses match as well as neighbours."""

from collections.abc import Sequence

import numpy as np
import pytest

from panolog.prepare.sfm.consistency.agreement import Posed
from panolog.prepare.sfm.consistency.contradictions import find_contradictions
from panolog.prepare.sfm.consistency.evidence import Evidence, Pair
from panolog.prepare.sfm.consistency.skeleton import Edge, Skeleton

COUNT, AROUND = 6, 360


def _contradictions(
    agreeing: list[Edge],
    against: list[Edge],
    ordered: bool,
    covers: float,
    shared: tuple[float, float] = (0.3, 0.3),
    guessed: frozenset[Edge] = frozenset(),
    fronts: Sequence[Edge] = (),
    first: float = 0.0,
    last: float = 0.5,
    copied: int = AROUND,
    misled: Edge | None = None,
) -> set[Edge]:
    """Of a walk within a ring of houses, each of which looks as that ten degrees further on.

    Args: pairs that agree besides the neighbours, and pairs with copies; covers, the coverage of the latter;
        shared, of the features by these, and by the neighbours 2 and 3; guessed, of the walk; fronts,
        pairs that agree on one side alone; first, last, metres along the walk of these two panoramas, while
        the others are 0.1 apart; copied, matches of a pair with copies; misled, neighbours with copies.
    """
    random = np.random.default_rng(0)
    turn = np.deg2rad(np.arange(AROUND))
    points = np.column_stack([8 * np.sin(turn), random.uniform(-3, 3, AROUND), 8 * np.cos(turn)])
    shifts = np.array([[0.1 * row, 0.0, 0.0] for row in range(COUNT)])
    shifts[[0, -1], 0] = first, last
    rays = [points + shift for shift in shifts]
    same = np.repeat(np.arange(AROUND)[:, None], 2, axis=1)
    copies = np.column_stack([same[:, 0], (same[:, 0] + 10) % AROUND])
    walk = [(row, row + 1) for row in range(COUNT - 1)]
    pairs = [
        Pair(edge, copies if edge == misled else same, 0.9, share=shared[1] if edge == (2, 3) else 0.3)
        for edge in walk
    ]
    pairs += [Pair(edge, same, 0.9, share=0.3) for edge in agreeing]
    pairs += [Pair(edge, same[: AROUND // 2], 0.9, share=0.3) for edge in fronts]
    pairs += [Pair(edge, copies[:copied], covers, share=shared[0]) for edge in against]
    unit = tuple(ray / np.linalg.norm(ray, axis=1, keepdims=True) for ray in rays)
    poses = {row: (np.eye(3), shift) for row, shift in enumerate(shifts)}
    found = Posed(poses, dict.fromkeys(range(COUNT), points))
    skeleton = Skeleton(ordered, frozenset(walk), guessed)
    against_ = find_contradictions(Evidence(unit, tuple(pairs)), skeleton, found, 2.0, lambda _: None)
    return {it.between for it in against_}


@pytest.mark.parametrize("agreeing", [[], [(0, 2), (1, 3), (2, 4), (3, 5)]])
def test_copies_count_where_they_outvote_what_agrees(agreeing: list[Edge]) -> None:
    against: list[Edge] = [(1, 4), (2, 5)]
    assert _contradictions(agreeing, against, True, 0.9) == (set() if agreeing else set(against))


@pytest.mark.parametrize(
    ("guess", "counts"), [((2, 3), {(1, 4), (2, 5)}), ((1, 2), {(1, 4)}), ((0, 1), set())]
)
def test_across_a_guess_a_single_one_counts_whatever_agrees(guess: Edge, counts: set[Edge]) -> None:
    """What agrees across a guess may be misled as the guess is."""
    agreeing: list[Edge] = [(0, 2), (1, 3), (2, 4), (3, 5)]
    assert _contradictions(agreeing, [(1, 4), (2, 5)], True, 0.9, guessed=frozenset({guess})) == counts


@pytest.mark.parametrize(
    ("agreeing", "ordered", "guessed", "counts"),
    [
        ([], True, [], True),
        ([(2, 4)], True, [], True),  # shares as much as the two, not more
        ([(2, 4), (1, 3)], True, [], False),
        ([(2, 4), (1, 3)], True, [(2, 3)], True),  # the next guess takes its place
        ([(2, 4), (1, 3)], False, [], True),
    ],
)
def test_neighbours_with_copies_count_unless_more_agrees_across_their_step(
    agreeing: list[Edge], ordered: bool, guessed: list[Edge], counts: bool
) -> None:
    found = _contradictions(agreeing, [], ordered, 0.9, guessed=frozenset(guessed), misled=(2, 3))
    assert found == ({(2, 3)} if counts else set())


@pytest.mark.parametrize("copied", [AROUND // 5, AROUND // 3])
def test_across_a_guess_with_far_more_matches_none_counts(copied: int) -> None:
    guessed: frozenset[Edge] = frozenset({(2, 3)})
    agreeing: list[Edge] = [(0, 2), (1, 3), (2, 4), (3, 5)]
    found = _contradictions(agreeing, [(1, 4)], True, 0.9, guessed=guessed, copied=copied)
    assert found == ({(1, 4)} if copied > AROUND // 4 else set())


@pytest.mark.parametrize(("covers", "counts"), [(0.9, True), (0.7, False)])
def test_without_an_order_copies_count_if_they_cover_as_much(covers: float, counts: bool) -> None:
    assert _contradictions([(0, 2)], [(1, 4)], False, covers) == ({(1, 4)} if counts else set())


@pytest.mark.parametrize(("weak", "counts"), [(0.2, True), (0.3, False)])
def test_without_an_order_copies_count_if_they_share_as_much_as_what_connects(
    weak: float, counts: bool
) -> None:
    assert _contradictions([], [(1, 4)], False, 0.9, (0.16, weak)) == ({(1, 4)} if counts else set())


_JUMP: frozenset[Edge] = frozenset({(4, 5)})


@pytest.mark.parametrize(
    ("front", "last", "counts"), [(True, 0.13, True), (False, 0.13, False), (True, 0.17, False)]
)
@pytest.mark.parametrize("ordered", [True, False])
def test_what_stands_closer_than_neighbours_shares_more_than_a_front(
    front: bool, last: float, counts: bool, ordered: bool
) -> None:
    """The walk returns to the second panorama, or jumps to where it looks the same."""
    whole, fronts = ([], [(1, 5)]) if front else ([(1, 5)], [])
    found = _contradictions(whole, [], ordered, 0.9, guessed=_JUMP, fronts=fronts, last=last)
    assert found == ({(1, 5)} if counts else set())


@pytest.mark.parametrize(
    ("one_place", "fronts", "guessed", "counts"),
    [
        ([], [(0, 5), (1, 5)], _JUMP, {(0, 5), (1, 5)}),
        ([(0, 5)], [(1, 5)], _JUMP, set()),
        ([], [(1, 5)], frozenset(), set()),
    ],
    ids=["fronts alone", "a close pair", "the walk"],
)
def test_a_front_does_not_count_where_others_show_one_place_across_the_same_way(
    one_place: list[Edge], fronts: list[Edge], guessed: frozenset[Edge], counts: set[Edge]
) -> None:
    """Shadows move: of two sessions, some of the pairs that stand close share what neighbours do in parts."""
    found = _contradictions(one_place, [], True, 0.9, guessed=guessed, fronts=fronts, first=0.09, last=0.13)
    assert found == counts
