"""Faces between cells: their sides, the cameras at them, and the regions that train once more."""

import numpy as np
import pytest
from numpy.typing import ArrayLike, NDArray

from panolog.partition.bounds import Aabb
from panolog.partition.cells import Cells, Cuts, Grid
from panolog.partition.contraction import contract, expand
from panolog.partition.faces import (
    between,
    cameras_at,
    distances_from,
    in_box,
    most_seen,
    planes_between,
    planes_within,
    seams_of,
    views_at,
)
from panolog.partition.plan import Plan
from panolog.partition.regions import Regions
from tests.partition.test_plan import planned

BOX = Aabb(np.array([-8.0, -4.0, -4.0]), np.array([8.0, 4.0, 4.0]))
T_JUNCTION = Cuts((("x", 0.5, 1), ("y", 0.4, 1), ("z", 0.6, 1)))
PARTITIONS: list[Cells] = [
    Grid((1, 1, 1)),
    Grid((2, 1, 1)),
    Grid((3, 2, 2)),
    Grid((5, 1, 3), "box"),
    T_JUNCTION,
]


@pytest.mark.parametrize("cells", PARTITIONS, ids=str)
def test_faces_are_all_of_the_cuts_and_have_their_blocks_on_both_sides(cells: Cells) -> None:
    def area(lower: ArrayLike, upper: ArrayLike, axis: int) -> float:
        return float(np.prod(np.delete(np.subtract(upper, lower), axis)))

    random, planes = np.random.default_rng(0), planes_between(cells)
    parts = sum(area(plane.lower, plane.upper, plane.axis) for plane in planes)
    assert parts == pytest.approx(sum(area(face.lower, face.upper, face.axis) for face in cells.faces))
    for plane in planes:
        points = random.uniform(plane.lower, plane.upper, (50, 3))
        points[:, plane.axis] = np.nextafter(plane.at, 0)
        assert (cells.block_of(points) == plane.below).all()
        points[:, plane.axis] = plane.at
        assert (cells.block_of(points) == plane.above).all()


def test_an_offset_is_in_world_units_and_missing_outside_of_the_face() -> None:
    plane = planes_between(Grid((2, 2, 1)))[0]
    assert (plane.below, plane.above, plane.axis) == (0, 1, 0)
    points = np.array([[0.5, -1.0, 0.0], [-3.0, -4.0, 2.0], [0.5, 1.0, 0.0], [0.5, 0.0, 0.0]])
    # the last is on the rim, which belongs to the next face
    np.testing.assert_allclose(plane.offsets(points, BOX), [0.5, -3.0, np.nan, np.nan], rtol=1e-12)


def test_the_distance_is_that_from_the_face_in_the_box() -> None:
    plane = planes_between(Grid((2, 2, 1)))[0]
    points = np.array([[3.0, -1.0, 0.0], [0.0, 2.0, 0.0], [3.0, -1.0, 8.0]])
    np.testing.assert_allclose(distances_from(points, *in_box([plane], BOX)), [3.0, 2.0, 5.0], rtol=1e-12)


def walk(cells: Cells, seen: int = 1, cameras: int = 25) -> Plan:
    """The plan of a walk along x, one camera for each unit."""
    centers = np.zeros((cameras, 3))
    centers[:, 0] = np.arange(cameras) - (cameras - 1) / 2 + 0.25
    scores = np.full((cameras, cells.count), float(seen))
    return planned(centers, centers, scores, cells, rho_tri=2.0, tau_grad=0.5)


def test_cameras_are_the_nearest_on_both_sides() -> None:
    plan = walk(Grid((2, 1, 1)))
    (plane,) = seams_of(plan)
    offsets = plane.offsets(plan.centers[list(cameras_at(plan, plane))], plan.aabb)
    np.testing.assert_allclose(offsets, [-1.0, -2.0, -3.0, 0.0, 1.0, 2.0], atol=1e-9)


def test_a_long_face_is_seen_in_several_places() -> None:
    """Two streets cross it, 20 apart: cameras of both are chosen on both sides."""
    x, y = np.meshgrid(np.arange(-6.0, 6.0) + 0.5, [-10.0, 10.0])
    centers = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1)
    plan = planned(centers, centers, np.ones((len(centers), 2)), Grid((2, 1, 1)), rho_tri=2.0)
    (plane,) = seams_of(plan)
    chosen = centers[list(cameras_at(plan, plane))]
    for side in (chosen[:3], chosen[3:]):
        assert {*side[:, 1]} == {-10.0, 10.0}
        assert sorted(np.abs(side[:, 0])) == [0.5, 0.5, 1.5]


def test_a_face_is_trained_by_the_cameras_of_both_blocks_near_it_and_checked_by_some() -> None:
    plan = walk(Grid((2, 1, 1)), cameras=41)
    (plane,) = seams_of(plan)
    distances = np.abs(plan.centers[:, 0] - plan.aabb.center[0])
    near = {plan.rows[k] for k in np.flatnonzero(distances <= 10.0)}
    assert len(near) < 41
    trained, checked = views_at(plan, plane, 8)
    held = [row for row in checked if row not in trained]
    assert near == {*trained, *held} and len(held) == 3 == len(checked) // 2
    assert len({*checked}) == len(checked)
    assert views_at(plan, plane, 1)[1][:1] == (held[0],) and len(views_at(plan, plane, 1)[1]) == 2
    assert views_at(plan, plane, 0) == (tuple(sorted(near)), ())


def test_a_virtual_camera_is_in_the_middle_of_a_pair() -> None:
    plan = walk(Grid((2, 1, 1)))
    (plane,) = seams_of(plan)
    found = between(plan, plane, cameras_at(plan, plane))
    assert found
    for k, place in found:
        other = plan.centers[plan.camera_blocks == 1][0]
        np.testing.assert_allclose(place, (plan.centers[k] + other) / 2)


def test_planes_within_a_block_are_among_its_cameras_and_away_from_its_faces() -> None:
    plan = walk(Grid((2, 1, 1)))
    planes = planes_within(plan, 1, 0)
    assert len(planes) == 3
    for plane in planes:
        assert (plane.below, plane.above) == (1, 1)
        middle = np.array(plane.lower)[None]
        middle[:, 1:] = 0.5
        assert 3.0 <= expand(middle, plan.aabb)[0, 0] - plan.aabb.center[0] <= 12.0
        assert len(cameras_at(plan, plane)) == 6


def test_the_faces_near_most_cameras_are_taken() -> None:
    plan = walk(Grid((4, 1, 1), "box"))
    faces = seams_of(plan)
    assert [plane.below for plane in most_seen(plan, faces, 9)] == [0, 1, 2]
    assert [plane.below for plane in most_seen(plan, faces, 1)] == [1]
    assert most_seen(plan, faces, 0) == ()


def test_where_a_side_has_no_cameras_or_was_not_trained_there_is_no_seam() -> None:
    trained, untrained = (walk(Grid((2, 1, 1)), seen=seen, cameras=4) for seen in (1, 0))
    assert trained.trained.all() and len(seams_of(trained)) == 1
    assert not untrained.trained.any() and seams_of(untrained) == ()
    one_sided = walk(Grid((1, 2, 1)))  # all cameras are on one side
    assert planes_between(one_sided.grid) and seams_of(one_sided) == ()


def places(seed: int = 0) -> NDArray[np.float64]:
    """Within the box, and far outside of it."""
    random = np.random.default_rng(seed)
    inside = random.uniform(BOX.lower, BOX.upper, (600, 3))
    return np.concatenate([inside, random.normal(scale=60.0, size=(150, 3))])


@pytest.mark.parametrize("cells", PARTITIONS, ids=str)
def test_a_margin_has_what_is_nearer_to_its_face_than_the_reach_and_to_no_other_of_its_cell(
    cells: Cells,
) -> None:
    faces, points = planes_between(cells), places(1)
    regions = Regions(BOX, cells, faces, reach=1.0)
    found, own = regions.of(points), cells.block_of(contract(points, BOX))
    offsets = np.abs([face.offsets(points, BOX) for face in faces]).reshape(len(faces), len(points))
    for away, region, cell in zip(offsets.T, found, own, strict=True):
        around = [i for i, face in enumerate(faces) if cell in (face.below, face.above)]
        near = {i: away[i] for i in around if away[i] < 1.0}
        if region >= len(faces):
            assert not near and region == len(faces) + cell
        else:
            assert near[region] == min(near.values())
    for number in range(len(faces)):
        inside = regions.margin(number).contains(points)
        assert inside.any() and (inside == (found == number)).all()
