"""Regions that train once more: without gap or overlap, margins as wide as they are meant to be."""

import numpy as np
import pytest
from numpy.typing import NDArray

from panolog.partition.bounds import Aabb
from panolog.partition.cells import Cells, Cuts, Grid
from panolog.partition.contraction import contract
from panolog.partition.faces import planes_between
from panolog.partition.regions import Regions

BOX = Aabb(np.array([-8.0, -4.0, -4.0]), np.array([8.0, 4.0, 4.0]))
T_JUNCTION = Cuts((("x", 0.5, 1), ("y", 0.4, 1), ("z", 0.6, 1)))
PARTITIONS: list[Cells] = [Grid((2, 1, 1)), Grid((3, 2, 2)), Grid((5, 1, 3), "box"), T_JUNCTION]


def places(seed: int = 0) -> NDArray[np.float64]:
    """Within the box, and far outside of it."""
    random = np.random.default_rng(seed)
    inside = random.uniform(BOX.lower, BOX.upper, (2000, 3))
    return np.concatenate([inside, random.normal(scale=60.0, size=(500, 3))])


@pytest.mark.parametrize("cells", PARTITIONS, ids=str)
def test_every_place_is_in_one_region(cells: Cells) -> None:
    faces = planes_between(cells)
    regions, points = Regions(BOX, cells, faces, reach=1.0), places()
    inside = np.stack([regions.margin(face).contains(points) for face in range(len(faces))])
    rest = regions.of(points) >= len(faces)  # of their cells
    assert (inside.sum(axis=0) == ~rest).all()
    assert inside.any(axis=1).all() and rest.any()


@pytest.mark.parametrize("cells", PARTITIONS, ids=str)
def test_a_margin_has_what_is_nearer_to_its_face_than_the_reach_and_to_no_other_of_its_cell(
    cells: Cells,
) -> None:
    faces, points = planes_between(cells), places(1)
    regions = Regions(BOX, cells, faces, reach=1.0)
    found, own = regions.of(points), cells.block_of(contract(points, BOX))
    for point, region, cell in zip(points, found, own, strict=True):
        offsets = [abs(face.offsets(point[None], BOX)[0]) for face in faces]
        around = {i: offsets[i] for i, face in enumerate(faces) if cell in (face.below, face.above)}
        near = {i: offset for i, offset in around.items() if offset < 1.0}
        if region >= len(faces):
            assert not near and region == len(faces) + cell
        else:
            assert near[region] == min(near.values())


def test_without_faces_the_regions_are_the_cells() -> None:
    cells, points = Grid((3, 2, 2)), places(2)
    regions = Regions(BOX, cells, (), reach=1.0)
    np.testing.assert_array_equal(regions.of(points), cells.block_of(contract(points, BOX)))


def test_a_place_that_is_not_finite_is_refused() -> None:
    with pytest.raises(ValueError, match="finite"):
        Regions(BOX, Grid((2, 1, 1)), (), reach=1.0).of([[0.0, np.nan, 0.0]])


def test_a_margin_says_what_it_is() -> None:
    cells = Grid((2, 1, 1))
    regions = Regions(BOX, cells, planes_between(cells), reach=1.0)
    assert str(regions.margin(0)) == "the face between blocks 0 and 1"
