import numpy as np
import pytest

from panolog.partition.assignment import assign, overlap


def test_position_or_gradient() -> None:
    scores = [[1.0, 0.81, 0.8], [0.1, 1.0, 0.5], [0.9, 0.1, 1.0]]
    assignment = assign([0, 0, 2], scores, 0.8)
    assert assignment.camera_blocks.tolist() == [0, 0, 2]
    assert assignment.gradient.toarray().tolist() == [
        [1, 1, 0],
        [0, 1, 0],
        [1, 0, 1],
    ]  # exactly tau_grad does not count
    assert assignment.assigned.toarray().tolist() == [[1, 1, 0], [1, 1, 0], [1, 0, 1]]
    assert assignment.counts.tolist() == [3, 2, 1]
    assert (assignment.cameras_of(1).tolist(), assignment.blocks_of(2).tolist()) == ([0, 1], [0, 2])
    assert assignment.by_gradient(1).tolist() == [1]
    assert (assignment.overlap, assignment.added) == (2.0, 3)


def test_no_gradient_at_all_leaves_the_geometric_block_only() -> None:
    assignment = assign([1], [[0.0, 0.0]], 0.0)
    assert not assignment.gradient.nnz
    assert assignment.assigned.toarray().tolist() == [[False, True]]


def test_the_size_of_scores_does_not_matter() -> None:
    scores = np.random.default_rng(1).random((20, 4))
    usual = assign(np.zeros(20, int), scores, 0.8).gradient.toarray()
    for factor in (1e-300, 1e-20, 1e300):
        found = assign(np.zeros(20, int), scores * factor, 0.8).gradient
        np.testing.assert_array_equal(found.toarray(), usual)


@pytest.mark.parametrize(
    ("block", "scores", "words"),
    [
        *[(0, scores, "scores") for scores in ([[np.nan, 1.0]], [[-1.0, 1.0]], [[np.inf, 1.0]], [[1.0]] * 2)],
        (2, [[1.0, 1.0]], "among 0 to 1"),
    ],
)
def test_bad_scores_and_blocks_are_refused(block: int, scores: list[list[float]], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        assign([block], scores, 0.8)


def test_overlap_grows_as_the_threshold_falls() -> None:
    scores = [[1.0, 0.7], [0.3, 1.0]]
    assert overlap([0, 1], scores, (1.0, 0.8, 0.5, 0.1)).tolist() == [1.0, 1.0, 1.5, 2.0]
    assert overlap([], np.zeros((0, 2)), (0.8,)).tolist() == [0.0]
