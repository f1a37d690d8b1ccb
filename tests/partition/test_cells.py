"""Contraction and cells together tile all of space: the property that makes the merge free of duplicates."""

import itertools
from typing import cast, get_args

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from panolog.partition.bounds import Aabb
from panolog.partition.cells import Axis, Cell, Cells, Cut, Cuts, Grid, Layout
from panolog.partition.contraction import contract, expand

sizes = st.integers(1, 7)
layouts = st.sampled_from(get_args(Layout))
grids = st.builds(lambda x, y, z, layout: Grid((x, y, z), layout), sizes, sizes, sizes, layouts)


@st.composite
def trees(draw: st.DrawFn) -> Cuts:
    """Cuts anywhere, in parts of equal shares or not."""
    random = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))

    def cut(blocks: int, lower: list[float], upper: list[float]) -> list[Cut]:
        if blocks == 1:
            return []
        axis, below = int(random.integers(3)), int(random.integers(1, blocks))
        at = float(random.choice([(lower[axis] + upper[axis]) / 2, random.uniform(lower[axis], upper[axis])]))
        first = cut(below, lower, [*upper[:axis], at, *upper[axis + 1 :]])
        second = cut(blocks - below, [*lower[:axis], at, *lower[axis + 1 :]], upper)
        return [(cast(Axis, "xyz"[axis]), at, below), *first, *second]

    return Cuts(tuple(cut(draw(st.integers(1, 40)), [0.0] * 3, [1.0] * 3)))


cells = st.one_of(grids, trees())
anything = st.one_of(
    st.floats(allow_nan=False, allow_infinity=False),
    st.floats(-3, 3),
    st.sampled_from([0.0, 1.0, -1.0, 1e30, -1e30, 3.4e38, -1.7e308, 1e-320]),
)
unit = st.floats(0, 1)


def lists(element: st.SearchStrategy[float]) -> st.SearchStrategy[NDArray[np.float64]]:
    rows = st.lists(st.tuples(element, element, element), min_size=1, max_size=20)
    return rows.map(lambda values: np.array(values, np.float64))


@st.composite
def boxes(draw: st.DrawFn) -> Aabb:
    lower = np.array(draw(st.tuples(*[st.floats(-100, 100)] * 3)))
    return Aabb(lower, lower + np.array(draw(st.tuples(*[st.floats(0.01, 1000)] * 3))))


def owners(points: NDArray[np.float64], box: Aabb, grid: Cells) -> NDArray[np.int64]:
    inside = [Cell(box, grid, block).contains(points) for block in range(grid.count)]
    total: NDArray[np.int64] = np.sum(inside, axis=0)
    return total


@settings(max_examples=60, deadline=None)
@given(cells, boxes(), lists(anything))
def test_every_finite_point_has_exactly_one_cell(grid: Cells, box: Aabb, points: NDArray[np.float64]) -> None:
    assert (owners(points, box, grid) == 1).all()
    contracted = contract(points, box)
    assert ((contracted >= 0.0) & (contracted < 1.0)).all()
    blocks = grid.block_of(contracted)
    assert ((blocks >= 0) & (blocks < grid.count)).all()


@settings(max_examples=100, deadline=None)
@given(cells, lists(unit))
@example(Grid((3, 7, 5)), np.array([[1 / 3, 3 / 7, 0.6], [np.nextafter(1 / 3, 0), 3 / 7, 1.0], [0, 0, 0]]))
def test_block_of_agrees_with_bounds(grid: Cells, contracted: NDArray[np.float64]) -> None:
    for point, block in zip(contracted, grid.block_of(contracted), strict=True):
        lower, upper = grid.bounds(int(block))
        assert ((lower <= point) & ((point < upper) | (upper == 1.0))).all()


@given(grids)
def test_blocks_of_a_grid_are_numbered_along_x_then_y_then_z(grid: Grid) -> None:
    corners = [grid.bounds(block)[0].tolist() for block in range(grid.count)]
    edges = [axis[:-1].tolist() for axis in grid.edges]
    assert corners == [[x, y, z] for z, y, x in itertools.product(*edges[::-1])]


@given(cells)
def test_faces_separate_the_cells_next_to_them(grid: Cells) -> None:
    for face in grid.faces:
        inside = (face.lower + face.upper) / 2
        inside[face.axis] = face.at
        above = int(grid.block_of(inside[None])[0])
        inside[face.axis] = np.nextafter(face.at, 0)
        below = int(grid.block_of(inside[None])[0])
        assert grid.bounds(above)[0][face.axis] == face.at == grid.bounds(below)[1][face.axis]


@settings(max_examples=100, deadline=None)
@given(boxes(), lists(st.floats(-30, 30)))
def test_expand_inverts_contract(box: Aabb, offsets: NDArray[np.float64]) -> None:
    points = box.center + offsets * box.half
    error = np.abs(expand(contract(points, box), box) - points) / box.half
    assert error.max() < 1e-9 * (1 + np.abs(offsets).max() ** 2) + 1e-11 * np.abs(box.center / box.half).max()


def test_contraction_matches_the_formula() -> None:
    box = Aabb(np.array([-1.0, -2, -4]), np.array([1.0, 2, 4]))
    points = np.array([[0.0, 0, 0], [1, 2, 4], [-1, 1, 0], [4, 4, 0]])  # the last has n = (4, 2, 0), m = 4
    expected = [[0.5, 0.5, 0.5], [0.75, 0.75, 0.75], [0.25, 0.625, 0.5], [0.9375, 0.71875, 0.5]]
    np.testing.assert_allclose(contract(points, box), expected, rtol=1e-15)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_points_that_are_not_finite_are_refused(bad: float) -> None:
    box, points = Aabb(np.zeros(3), np.ones(3)), np.array([[0.0, bad, 0.0]])
    with pytest.raises(ValueError, match="finite"):
        contract(points, box)
    with pytest.raises(ValueError, match="cube"):
        Grid((2, 1, 1)).block_of(points)
    assert Grid((2, 1, 1)).block_of(contract(np.empty((0, 3)), box)).shape == (0,)


@pytest.mark.parametrize("face", [0.0, 1.0])
def test_faces_of_the_cube_have_no_place_in_the_world(face: float) -> None:
    with pytest.raises(ValueError, match="open unit cube"):
        expand(np.array([[face, 0.5, 0.5]]), Aabb(np.zeros(3), np.ones(3)))


def test_parse() -> None:
    assert Grid.parse("2x1x3") == Grid((2, 1, 3))
    assert str(Grid((2, 1, 3))) == "2x1x3"


@pytest.mark.parametrize(
    "text", ["", "2", "2x1", "0x1x1", "-1x1x1", "2x1x1x1", "axbxc", "1.5x1x1", "²x1x1", "auto", "99x99x99"]
)
def test_nonsense_grids_are_refused(text: str) -> None:
    with pytest.raises(ValueError, match="2x1x1"):
        Grid.parse(text)


@pytest.mark.parametrize(
    "cuts",
    [[("x", 0.0, 1)], [("z", 1.0, 1)], [("y", 0.5, 0)], [("x", 0.5, 2)], [("x", 0.5, 1), ("x", 0.5, 1)]],
)
def test_cuts_with_an_empty_side_are_refused(cuts: list[Cut]) -> None:
    with pytest.raises(ValueError, match="has an empty side"):
        Cuts(tuple(cuts))


def test_a_block_that_does_not_exist_is_refused() -> None:
    with pytest.raises(ValueError, match="the 2 blocks are 0 to 1, not -1"):
        Cuts((("x", 0.5, 1),)).bounds(-1)
    with pytest.raises(ValueError, match="blocks 0 to 1"):
        Cell(Aabb(np.zeros(3), np.ones(3)), Grid((2, 1, 1)), 2)
