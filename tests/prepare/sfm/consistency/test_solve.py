"""A square with four equal sides: in order, in any order, and where the sides cannot be distinguished."""

from dataclasses import replace
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import pytest
from scipy.spatial.transform import Rotation

from panolog.prepare.sfm.consistency.agreement import Posed, deviations
from panolog.prepare.sfm.consistency.skeleton import Skeleton
from panolog.prepare.sfm.consistency.solution import Solution
from panolog.prepare.sfm.consistency.solve import Solver
from panolog.prepare.sfm.links import Link
from panolog.prepare.sfm.mapping import map_pairs
from panolog.prepare.sfm.sparse_model import SparseModel
from panolog.prepare.sfm.workspace import Workspace, silence_colmap
from panolog.scene.write import no_progress
from tests.prepare.sfm.accuracy import length
from tests.prepare.sfm.consistency.simulated import SIZE, Place, parts_of, square
from tests.prepare.sfm.consistency.sweep import off

pytestmark = pytest.mark.system

COUNT = 16  # panoramas, four for each side


def _solve(place: Place) -> Solution:
    (found,) = parts_of(place)
    return found


def _error(place: Place, found: Solution) -> float:
    """Metres, of all panoramas."""
    assert len(found.found.poses) == len(place.centers)
    return off(found, place.centers)


def test_neighbours_in_order_outweigh_sides_that_look_the_same(tmp_path: Path) -> None:
    place = square(tmp_path, count=COUNT, ground=0.0)
    found = _solve(place)
    assert found.skeleton.ordered
    assert _error(place, found) < 0.002 * length(place.centers)
    assert found.trusted


def test_a_guess_where_the_walk_jumps_is_refuted_and_another_pair_joins_the_parts(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The walk jumps to where the opposite side looks the same, and returns from there.

    What a wrong guess misleads is mapped no further than it takes to see that.
    """
    mapped = list[int]()

    def counted(work: Workspace, *others: Any) -> list[pycolmap.Reconstruction]:
        with pycolmap.Database.open(work.database) as database:
            mapped.append(len(database.read_two_view_geometries()[0]))
        return map_pairs(work, *others)

    monkeypatch.setattr("panolog.prepare.sfm.consistency.solve.map_pairs", counted)
    monkeypatch.setattr("panolog.prepare.sfm.consistency.skeleton._CLEAR", np.inf)  # the jump is tried first
    order = np.array([0, 1, 2, 3, 4, 5, 13, 12, 11, 10, 9, 8, 7, 6, 14, 15])
    place = square(tmp_path, count=COUNT, order=order, ground=0.5)
    found = _solve(place)
    assert found.skeleton.ordered and found.trusted
    assert _error(place, found) < 0.1
    assert len(mapped) == 4  # twice with the wrong guess, and twice with the right one


def test_a_guess_beyond_which_no_poses_are_found_is_replaced_before_others_are_mapped(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Nothing contradicts what such a guess leads to, as that has no poses."""
    jump, posed = (5, 6), list[int]()

    def without_jump(work: Workspace, *others: Any) -> list[pycolmap.Reconstruction]:
        one, other = (work.ids()[row] for row in jump)
        with pycolmap.Database.open(work.database) as database:
            if database.exists_two_view_geometry(one, other):
                database.delete_two_view_geometry(one, other)
        models = map_pairs(work, *others)
        posed.append(max((model.num_reg_images() for model in models), default=0))
        return models

    monkeypatch.setattr("panolog.prepare.sfm.consistency.solve.map_pairs", without_jump)
    monkeypatch.setattr("panolog.prepare.sfm.consistency.skeleton._CLEAR", np.inf)  # the jump is tried first
    order = np.array([0, 1, 2, 3, 4, 5, 13, 12, 11, 10, 9, 8, 7, 6, 14, 15])
    place = square(tmp_path, count=COUNT, order=order, ground=0.5)
    found = _solve(place)
    assert found.trusted and _error(place, found) < 0.1
    assert jump not in found.skeleton.tree
    assert posed[0] < COUNT == posed[1]
    walk = frozenset((row, row + 1) for row in range(COUNT - 1))
    skeleton = Skeleton(True, walk, guessed=frozenset({(9, 10), (13, 14)}))
    for last, vain in ((9, {(9, 10)}), (13, set())):  # the few after the other are added last
        poses = {row: found.found.poses[row] for row in range(last + 1)}
        assert replace(found, found=Posed(poses, {}), skeleton=skeleton, contradictions=[]).vain == vain
    skeleton = replace(skeleton, guessed=frozenset({(5, 6), (8, 9), (10, 11)}))
    begun = replace(found, found=Posed({row: found.found.poses[row] for row in range(6)}, {}))
    begun = replace(begun, skeleton=skeleton, contradictions=[])
    assert begun.vain == {(5, 6)}
    smaller = [{4, 5, *range(6, 11)}, {9, 10}]  # a smaller reconstruction leads across the first guess
    assert replace(begun, others=smaller).vain == {(10, 11)}
    assert replace(begun, others=[set(range(6, 11))]).vain == {(5, 6), (10, 11)}


@pytest.mark.parametrize("ordered", [True, False])
def test_a_jump_to_a_look_alike_with_what_lies_between_missing_is_not_trusted(
    tmp_path: Path, ordered: bool
) -> None:
    """All pairs across the jump agree, as no true neighbours are among them, but share fronts alone."""
    walk = np.array([0, 1, 2, 3, 4, 5, 13, 12, 11, 10])
    order = walk if ordered else np.random.default_rng(4).permutation(walk)
    place = square(tmp_path, count=COUNT, order=order)
    with silence_colmap():
        solver = Solver(place.work, SIZE, "incremental", 2.0, no_progress)
        assert ordered or solver.parts(3) == []
        parts = solver.parts(3, doubtful=True)
    assert ordered or solver.cuts
    assert not ordered or [{*part.found.poses} for part in parts] == [{*range(6)}, {*range(6, 10)}]
    assert parts and all(part.trusted for part in parts)
    for part in parts:
        assert off(part, place.centers) < 0.1


def test_where_it_is_cut_a_guess_that_nothing_contradicts_stays(tmp_path: Path) -> None:
    """The walk jumps to a look-alike, and in the end next to where it began."""
    place = square(tmp_path, count=24, order=np.array([*range(8), *range(19, 9, -1), 22, 23]))
    parts = parts_of(place)
    assert [{*part.found.poses} for part in parts] == [{*range(8), 18, 19}, {*range(8, 18)}]


def test_a_loop_is_mapped_that_drift_has_left_open(tmp_path: Path) -> None:
    """Each panorama is turned against the one before, and the last one is off by the sum of all turns."""
    count, degrees = 24, 0.4
    found, returning = _solve(square(tmp_path, count=count)), {(0, count - 1), (0, count - 2), (1, count - 1)}
    assert returning <= found.agreeing.keys()
    poses, points = dict(found.found.poses), dict(found.found.points)
    for row, (rotation, shift) in found.found.poses.items():
        turn = Rotation.from_euler("z", degrees * row, degrees=True).as_matrix()
        center = -rotation.T @ shift
        poses[row] = (rotation @ turn.T, -rotation @ turn.T @ center)
        points[row] = (found.found.points[row] - center) @ turn.T + center
    pairs = {pair.between: pair for pair in found.evidence.pairs}
    tree = {edge: pairs[edge].matches for edge in found.skeleton.tree}
    drifted = replace(found, found=Posed(poses, points), kept=tree, contradictions=[])
    for edge in returning:
        assert np.nanmedian(deviations(drifted.found, found.evidence, pairs[edge])) > 6
        assert edge in drifted.agreeing
    assert not drifted.settled


@pytest.mark.parametrize("dusk", [None, 10], ids=["one light", "two"])
def test_a_walk_that_returns_to_where_it_was_is_whole_in_any_light(tmp_path: Path, dusk: int | None) -> None:
    """What is next to each other shares few matches that show a motion, and in another light few at all."""
    place = square(tmp_path, count=COUNT, order=np.array([*range(10), 4, 5, 6, 7]), again=0.5, dusk=dusk)
    found = _solve(place)
    assert found.trusted and _error(place, found) < 0.1


def test_without_order_what_lies_around_tells_sides_apart(tmp_path: Path) -> None:
    place = square(tmp_path, count=COUNT, order=np.random.default_rng(4).permutation(COUNT))
    found = _solve(place)
    assert not found.skeleton.ordered
    assert _error(place, found) < 0.1  # on a square of 16


@pytest.mark.parametrize("ordered", [True, False])
def test_a_pose_that_a_single_pair_holds_needs_the_order(tmp_path: Path, ordered: bool) -> None:
    """The two ends of the walk, which each share something with one panorama alone."""
    order = np.arange(COUNT) if ordered else np.random.default_rng(4).permutation(COUNT)
    place = square(tmp_path, count=COUNT, order=order)
    first, last = (int(np.flatnonzero(order == end)[0]) for end in (0, COUNT - 1))
    ids = place.work.ids()
    with pycolmap.Database.open(place.work.database) as database:
        database.delete_two_view_geometry(ids[first], ids[last])
    with silence_colmap():
        solver = Solver(place.work, SIZE, "incremental", 2.0, no_progress)
        (found,) = solver.parts(3)
    assert found.skeleton.ordered == ordered
    assert solver.unconfirmed == (set() if ordered else {first, last})
    assert found.found.poses.keys() == {*range(COUNT)} - solver.unconfirmed


@pytest.mark.parametrize(
    ("shared", "added"), [({0, 22}, True), ({5, 11}, False)], ids=["neighbours", "look-alikes"]
)
def test_a_panorama_that_what_agrees_does_not_reach_is_added_last(
    tmp_path: Path, shared: set[int], added: bool
) -> None:
    """The tree has none of the few features that it shares. It is added by all of them, if these agree."""
    place = square(tmp_path, count=24)
    ids, last = place.work.ids(), 23
    with pycolmap.Database.open(place.work.database) as database:
        for row in range(last):
            geometry = database.read_two_view_geometry(ids[row], ids[last])
            database.delete_two_view_geometry(ids[row], ids[last])
            if row in shared:
                geometry.inlier_matches = geometry.inlier_matches[:60]  # of a front
                database.write_two_view_geometry(ids[row], ids[last], geometry)
    (found,) = parts_of(place)
    assert last not in {row for edge in found.skeleton.tree for row in edge}
    assert (last in found.found.poses) == added
    assert found.trusted and off(found, place.centers) < 0.1


def test_what_contradicts_when_it_is_added_stays_out(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The others that no poses reached are added without it, though the tree connects it."""
    place, wrong, right = square(tmp_path, count=COUNT), 6, 13
    ids = place.work.ids()

    def reaching(*arguments: Any) -> list[pycolmap.Reconstruction]:
        (model, *_) = map_pairs(*arguments)
        if arguments[-1] is None:
            for row in (wrong, right):
                model.deregister_frame(model.image(ids[row]).frame_id)
        elif ids[wrong] in model.reg_image_ids():
            image = model.image(ids[wrong])
            behind = pycolmap.Rigid3d(pycolmap.Rotation3d(np.diag([-1.0, 1.0, -1.0])), np.zeros(3))
            model.frame(image.frame_id).set_cam_from_world(image.camera_id, behind)
        return [model]

    monkeypatch.setattr("panolog.prepare.sfm.consistency.solve.map_pairs", reaching)
    found = _solve(place)
    assert found.found.poses.keys() == {*range(COUNT)} - {wrong}
    assert found.trusted and off(found, place.centers) < 0.1


def test_what_has_shrunk_to_a_point_is_another_part(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Where a step seems to lead back, what follows fits if it is small enough, and nothing contradicts."""
    place, behind, tiny = square(tmp_path, count=COUNT), 10, 1e-6
    ids = place.work.ids()

    def shrinking(*arguments: Any) -> list[pycolmap.Reconstruction]:
        models = map_pairs(*arguments)
        model = next((it for it in models if it.num_reg_images() == COUNT), None)
        if model is None:
            return models
        center = model.image(ids[behind]).projection_center()
        for image in map(model.image, ids[behind:]):
            turn = image.cam_from_world().rotation
            shift = -turn.matrix() @ (center + tiny * (image.projection_center() - center))
            model.frame(image.frame_id).set_cam_from_world(image.camera_id, pycolmap.Rigid3d(turn, shift))
        for number in model.point3D_ids():
            point = model.point3D(number)
            sides = {ids.index(it.image_id) >= behind for it in point.track.elements}
            if sides == {True}:
                point.xyz = center + tiny * (point.xyz - center)
            elif len(sides) == 2:
                model.delete_point3D(number)
        return models

    monkeypatch.setattr("panolog.prepare.sfm.consistency.solve.map_pairs", shrinking)
    found = parts_of(place)
    assert [sorted(part.found.poses) for part in found] == [[*range(behind)], [*range(behind, COUNT)]]
    assert max(off(part, place.centers) for part in found) < 0.1


def test_what_nothing_holds_the_scale_of_is_another_part(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Links that no points hold are known to be weak, but need not be wrong."""
    weak = [Link((2, 3), (0, 1, 2), 0, np.inf), Link((1, 2), (0, 1), 3, 9.0)]

    def links(model: SparseModel, width: int) -> list[Link]:
        loose = Link((9, 10), tuple(range(10, COUNT)), 3, 1e8)
        return [weak[0], loose, weak[1]] if len(model.rows) == COUNT else weak

    monkeypatch.setattr("panolog.prepare.sfm.consistency.solution.links_of", links)
    place = square(tmp_path, count=COUNT)
    found = parts_of(place)
    assert [sorted(part.found.poses) for part in found] == [[*range(10)], [*range(10, COUNT)]]


@pytest.mark.parametrize("near", [0.005, 0.0005])
def test_panoramas_all_around_which_is_near_have_shrunk(near: float) -> None:
    """A flight and a room differ by a hundred times; a step that seems to lead back shrinks all."""
    around = np.random.default_rng(3).normal(size=(50, 3))
    points = {row: (near if row == 2 else 1.0) * around + [row, 0.0, 0.0] for row in range(5)}
    points |= {3: np.concatenate([points[3], np.full((9, 3), np.nan)]), 4: np.full((9, 3), np.nan)}
    poses = {row: (np.eye(3), np.array([-row, 0.0, 0.0])) for row in range(5)}
    assert Posed(poses, points).shrunk() == (set() if near > 0.001 else {2})


def test_at_last_all_pairs_that_agree_are_matched_along_their_motions(tmp_path: Path) -> None:
    """Before that only those of the tree are, and a thin chain drifts."""
    place, few = square(tmp_path, count=COUNT), 60
    ids, random = place.work.ids(), np.random.default_rng(5)
    with pycolmap.Database.open(place.work.database) as database:
        for one, other in combinations(ids, 2):
            geometry = database.read_two_view_geometry(one, other)
            geometry.inlier_matches = random.permutation(geometry.inlier_matches)[:few]
            database.delete_two_view_geometry(one, other)
            database.write_two_view_geometry(one, other, geometry)
    found = _solve(place)
    assert found.trusted and _error(place, found) < 0.01
    others = [len(matches) for edge, matches in found.kept.items() if edge not in found.skeleton.tree]
    assert others and np.median(others) > 1.5 * few


def test_without_order_true_neighbours_share_more_than_those_that_look_alike(tmp_path: Path) -> None:
    place = square(tmp_path, count=COUNT, ground=0.0, order=np.random.default_rng(4).permutation(COUNT))
    found = _solve(place)
    assert found.trusted and len(found.found.poses) == COUNT and _error(place, found) < 0.01


def test_what_nothing_tells_apart_is_refused(tmp_path: Path) -> None:
    order = np.random.default_rng(4).permutation(COUNT)
    place = square(tmp_path, count=COUNT, ground=0.0, points=0.3, order=order)
    with silence_colmap():
        solver = Solver(place.work, SIZE, "incremental", 2.0, no_progress)
        assert solver.parts(3) == [] and solver.cuts
        assert solver.parts(3, doubtful=True) == []  # each would be 7 metres off
