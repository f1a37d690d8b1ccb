"""Which pairs carry a reconstruction, and which of its pairs contradict it."""

import tracemalloc
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from panolog.prepare.sfm.consistency.contradictions import (
    Contradiction,
    consistent_part,
    is_repetitive,
    is_trusted,
    refuted_guesses,
)
from panolog.prepare.sfm.consistency.evidence import Evidence, Pair, with_coverage
from panolog.prepare.sfm.consistency.skeleton import Skeleton, find_skeleton, hops

NOTHING = np.empty((0, 2), np.int64)


Edge = tuple[int, int]


def _evidence(coverages: dict[Edge, float], count: int, rivalled: Sequence[Edge] = ()) -> Evidence:
    pairs = tuple(
        Pair(it, NOTHING, share, rivalled=it in rivalled) for it, share in sorted(coverages.items())
    )
    return Evidence(tuple(np.empty((0, 3)) for _ in range(count)), pairs)


def test_neighbours_in_order_come_first_even_if_others_share_more() -> None:
    walk = {(row, row + 1): 0.8 for row in range(5)}
    found = find_skeleton(_evidence(walk | {(0, 3): 0.95, (1, 4): 0.95}, 6))
    assert found.ordered
    assert found.tree == set(walk)


def test_without_order_those_that_share_most_of_the_sphere() -> None:
    coverages = {(0, 3): 0.9, (3, 1): 0.9, (1, 4): 0.85, (2, 4): 0.8, (0, 4): 0.6, (0, 1): 0.5}
    found = find_skeleton(_evidence({(min(it), max(it)): value for it, value in coverages.items()}, 5))
    assert not found.ordered
    assert found.tree == {(0, 3), (1, 3), (1, 4), (2, 4)}


def test_without_order_what_covers_much_and_shares_little_comes_last() -> None:
    """A meadow that repeats is all around."""
    walk = [(0, 3), (1, 3), (1, 4), (2, 4)]
    pairs = [Pair(it, NOTHING, 0.8, share=0.3) for it in walk]
    pairs.append(Pair((0, 2), NOTHING, 0.9, share=0.1))
    found = find_skeleton(Evidence(tuple(np.empty((0, 3)) for _ in range(5)), tuple(pairs)))
    assert not found.ordered and found.tree == set(walk)


@pytest.mark.parametrize(("share", "other", "joined"), [(0.2, 0.7, True), (0.5, 0.9, False)])
def test_an_interrupted_walk_is_joined_where_most_is_shared(share: float, other: float, joined: bool) -> None:
    """Neighbours that share less come before others, but are guesses."""
    walk = {(row, row + 1): 0.8 for row in range(11)} | {(5, 6): share}
    found = find_skeleton(_evidence(walk | {(2, 9): other}, 12))
    assert found.ordered
    assert ((2, 9) in found.tree, (5, 6) in found.tree) == (joined, not joined)
    assert joined or found.guessed == {(5, 6)}


@pytest.mark.parametrize(("share", "guessed"), [(0.2, {(5, 6)}), (0.3, set())])
def test_neighbours_that_share_few_features_are_a_guess(share: float, guessed: set[Edge]) -> None:
    """Copies of houses all around cover as much as neighbours do, but the ground is not among them."""
    pairs = tuple(Pair((row, row + 1), NOTHING, 0.8, share=share if row == 5 else 0.36) for row in range(11))
    found = find_skeleton(Evidence(tuple(np.empty((0, 3)) for _ in range(12)), pairs))
    assert found.tree == {pair.between for pair in pairs}
    assert found.guessed == guessed


@pytest.mark.parametrize(("share", "more"), [(0.6, True), (0.2, False), (0.0, False)])
def test_what_shares_more_than_neighbours_do_comes_before_feeble_ones(share: float, more: bool) -> None:
    """A street that looks alike covers more than a long step does, but of other features: it comes after."""
    walk = [Pair((row, row + 1), NOTHING, 0.8, share=0.36) for row in range(11)]
    walk[5] = Pair((5, 6), NOTHING, 0.5, share=0.1)
    found = find_skeleton(
        Evidence(
            tuple(np.empty((0, 3)) for _ in range(12)),
            (*walk, *[Pair((2, 9), NOTHING, 0.9, share=share)] * (share > 0)),
        )
    )
    assert found.guessed == {(2, 9) if more else (5, 6)}
    assert len(found.tree) == 11


@pytest.mark.parametrize(
    ("third", "more"), [(None, True), ((4, 9), True), ((6, 9), True), ((9, 17), False), ((2, 16), False)]
)
def test_what_looks_like_several_places_comes_after_feeble_neighbours(third: Edge | None, more: bool) -> None:
    """Copies of a place share more than feeble neighbours do, but about as much with other copies of it."""
    walk = [Pair((row, row + 1), NOTHING, 0.8, share=0.36) for row in range(19)]
    walk[5] = Pair((5, 6), NOTHING, 0.5, share=0.1)
    others = [Pair((2, 9), NOTHING, 0.9, share=0.6)]
    others += [] if third is None else [Pair(third, NOTHING, 0.9, share=0.4)]
    found = find_skeleton(Evidence(tuple(np.empty((0, 3)) for _ in range(20)), (*walk, *others)))
    assert found.guessed == {(2, 9) if more else (5, 6)}


def test_neighbours_stay_where_others_of_the_tree_cover_more() -> None:
    """What is joined out of order covers more than neighbours do: it does not make these a guess."""
    walk = {(row, row + 1): 0.6 if row < 9 else 0.7 for row in range(16)} | {(5, 6): 0.46}
    found = find_skeleton(_evidence(walk | {(3, 17): 1.0, (8, 18): 1.0, (12, 19): 1.0}, 20))
    assert found.ordered and set(walk) <= found.tree
    assert found.guessed == {(3, 17), (8, 18), (12, 19)}


def test_what_has_many_rivals_is_not_trusted_and_is_cut_at_them() -> None:
    edges = [(row, row + 1) for row in range(9)]
    evidence = _evidence(dict.fromkeys(edges, 0.9), 10, edges[:3])
    skeleton = find_skeleton(evidence)
    assert skeleton.rivalled == set(edges[:3])
    assert is_repetitive(skeleton, range(10))
    assert not is_trusted([], skeleton, range(10))
    assert is_trusted([], skeleton, range(2, 10))
    assert consistent_part(range(10), [], skeleton, evidence) == list(range(3, 10))


def test_known_places_take_the_part_of_the_order() -> None:
    places = np.array([[0.0, 0, 0], [5, 0, 0], [1, 0, 0], [4, 0, 0]])
    every = {(a, b): 0.5 + 0.1 * (a == 0) for a in range(4) for b in range(a + 1, 4)}
    assert find_skeleton(_evidence(every, 4), places).tree == {(0, 2), (1, 3), (2, 3)}


def test_coverage_counts_directions_and_not_features() -> None:
    around = np.linspace(-np.pi, np.pi, 60, endpoint=False) + 0.01
    rays = np.column_stack([np.sin(around), np.zeros(60), np.cos(around)])
    every = np.repeat(np.arange(60)[:, None], 2, axis=1)
    for matches, share in ((every, 1.0), (every[:30], 0.5), (every[::2], 1.0), (every[::5], 0.0)):
        pairs = [Pair((0, 1), every), Pair((0, 2), matches), Pair((2, 3), every)]
        assert with_coverage([rays] * 4, pairs)[1].coverage == share


def test_edges_between_pairs_in_little_memory() -> None:
    tree, pairs = {(0, 1), (1, 4), (2, 4)}, [(0, 1), (0, 2), (0, 3), (0, 4), (1, 2)]
    assert hops(tree, 5, pairs, 9) == dict(zip(pairs, (1, 3, np.inf, 2, 2), strict=True))
    assert hops(tree, 5, pairs, 2) == dict(zip(pairs, (1, np.inf, np.inf, 2, 2), strict=True))
    assert hops([], 5, pairs, 9) == dict.fromkeys(pairs, np.inf)
    count = 20_000
    chain, near = [[(row, row + step) for row in range(count - step)] for step in (1, 3)]
    tracemalloc.start()
    found = hops(chain, count, near, 20)
    most = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert set(found.values()) == {3}
    assert most < 2e8  # a table of all takes 3.2 GB


def test_trust() -> None:
    skeleton = Skeleton(True, frozenset((row, row + 1) for row in range(299)))
    other = [Contradiction((0, 2), 80, 3)]
    assert is_trusted([], skeleton, range(3))
    assert is_trusted(other, skeleton, range(3))
    assert not is_trusted([*other, Contradiction((0, 3), 80, 3)], skeleton, range(30))
    assert is_trusted([*other, Contradiction((0, 3), 80, 3)], skeleton, range(300))
    assert not is_trusted([Contradiction((1, 2), 80, 3)], skeleton, range(300))
    split = replace(skeleton, tree=skeleton.tree - {(0, 1)})
    assert is_trusted([], split, range(3)) and not is_trusted(other, split, range(3))
    guess = replace(skeleton, guessed=frozenset({(1, 2)}))  # believed only without a contradiction
    assert is_trusted([], guess, range(3)) and not is_trusted(other, guess, range(3))
    assert is_trusted(other, guess, range(200)) and not is_trusted(other, guess, range(199))


def test_the_part_that_agrees_is_cut_where_the_tree_is_weakest() -> None:
    walk = {(row, row + 1): 0.9 for row in range(9)} | {(6, 7): 0.4}
    evidence = _evidence(walk, 10)
    skeleton = Skeleton(True, frozenset(walk))
    for edge, part in (((2, 9), range(7)), ((3, 4), range(4, 10)), (None, range(10))):
        doubt = [] if edge is None else [Contradiction(edge, 80, 3)]
        assert consistent_part(range(10), doubt, skeleton, evidence) == list(part)
    later = Skeleton(False, frozenset((row, row + 1) for row in range(1, 9)))  # nothing carries the first
    assert consistent_part(range(10), [Contradiction((0, 5), 80, 3)], later, evidence) == [*range(1, 10)]
    sides = Skeleton(False, frozenset(walk) - {(4, 5)})  # each side is a part of its own anyway
    assert consistent_part(range(10), [Contradiction((2, 9), 80, 3)], sides, evidence) == [*range(10)]


def test_panoramas_whose_poses_are_known_need_no_pairs_and_one_edge_joins_others_with_them() -> None:
    """Two walks in order, of which the first is known: what looks like its end is not in the tree."""
    walk = {(row, row + 1): 0.8 for row in range(4, 7)}
    skeleton = find_skeleton(_evidence(walk | {(0, 5): 0.75, (3, 7): 0.7}, 8), given=range(4))
    assert skeleton.ordered and skeleton.tree == {*walk, (0, 5)}
    assert skeleton.guessed == refuted_guesses([Contradiction((3, 7), 90, 1)], skeleton, {}) == {(0, 5)}
    assert refuted_guesses([Contradiction((5, 7), 90, 1)], skeleton, {}) == set()
    other = find_skeleton(_evidence(walk | {(0, 5): 0.75, (3, 7): 0.7}, 8), given=range(4), refuted={(0, 5)})
    assert other.tree == {*walk, (3, 7)}  # the next guess
    part = consistent_part(
        range(8), [Contradiction((3, 7), 90, 1)], skeleton, _evidence(walk | {(0, 5): 0.75}, 8)
    )
    assert part == [0, 1, 2, 3]  # the known side stays, although the other is as large
    assert skeleton.among([1, 2, 5, 6]).edges == {(1, 2), (5, 6)}


def test_of_many_guesses_those_are_refuted_that_most_contradictions_lead_across() -> None:
    walk = [(row, row + 1) for row in range(9)]
    skeleton = Skeleton(True, frozenset(walk), guessed=frozenset({(1, 2), (4, 5), (7, 8)}))
    kept = dict.fromkeys([*walk, (1, 3), (7, 9)], np.zeros((100, 2), np.int64))
    across = [Contradiction(ends, 90, 0) for ends in ((0, 5), (3, 6), (4, 9))]
    assert refuted_guesses(across, skeleton, kept) == {(4, 5)}
    assert refuted_guesses(across[:1], skeleton, kept) == set()  # the guess has more matches
    assert refuted_guesses([Contradiction((4, 5), 3, 3)], skeleton, kept) == {(4, 5)}  # it contradicts itself
    strong = Contradiction((0, 9), 101, 0)
    assert refuted_guesses([strong], skeleton, kept) == {(4, 5)}  # fewest pairs agree across it
    assert refuted_guesses([strong], skeleton, {}) == skeleton.guessed  # any of them
    many = replace(skeleton, guessed=frozenset(walk[:4]))
    assert refuted_guesses([strong], many, {}) == set()  # nothing says which of so many
    both = [*across, Contradiction((6, 9), 101, 0)]
    assert refuted_guesses(both, skeleton, kept) == {(4, 5), (7, 8)}
