"""Poses that are adjusted as a whole: once loops are closed, where the mapper drifts, and at last."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import pytest
from scipy.spatial.transform import Rotation

from panolog.prepare.sfm.consistency.agreement import posed
from panolog.prepare.sfm.consistency.contradictions import Contradiction, find_contradictions
from panolog.prepare.sfm.consistency.evidence import Evidence
from panolog.prepare.sfm.consistency.solution import Solution
from panolog.prepare.sfm.mapping import _drop_far, adjust_poses, map_pairs
from panolog.prepare.sfm.workspace import Workspace, silence_colmap
from tests.prepare.sfm.accuracy import drift
from tests.prepare.sfm.consistency.simulated import Place, parts_of, square
from tests.prepare.sfm.consistency.sweep import off

pytestmark = pytest.mark.system

COUNT = 16  # panoramas


def _solve(place: Place) -> Solution:
    (found,) = parts_of(place)
    assert len(found.found.poses) == COUNT
    return found


@pytest.mark.parametrize("misfits", [0, 1])
def test_of_many_some_pairs_may_fit_less_once_all_is_adjusted(
    misfits: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    module, last = "panolog.prepare.sfm.consistency.solve", list[bool]()

    def adjusting(*arguments: Any, **named: Any) -> pycolmap.Reconstruction | None:
        last.append(named.get("last", False))
        return adjust_poses(*arguments, **named)

    def contradicting(*arguments: Any) -> list[Contradiction]:
        return [Contradiction((0, 1), 50, 0)] if any(last) else find_contradictions(*arguments)

    monkeypatch.setattr(f"{module}.adjust_poses", adjusting)
    monkeypatch.setattr(f"{module}.find_contradictions", contradicting)
    place = square(tmp_path, count=COUNT)
    before = sum(map(len, _solve(place).kept.values()))  # one pair in so few panoramas is too many
    monkeypatch.setattr(f"{module}._MISFITS", misfits / COUNT)
    last.clear()
    after = _solve(place)
    assert after.contradictions == []
    assert (sum(map(len, after.kept.values())) > before) == (misfits > 0)


def _noted(monkeypatch: pytest.MonkeyPatch, missing: int | None = None) -> list[str]:
    """What is called from now on, with fewer panoramas that COLMAP's mapper adjusts.

    Args: missing, one that has no pose at first.
    """
    module, calls = "panolog.prepare.sfm.consistency.solve", list[str]()

    def mapping(work: Workspace, *others: Any) -> list[pycolmap.Reconstruction]:
        models = map_pairs(work, *others)
        if missing is not None and "map" not in calls:
            models[0].deregister_frame(models[0].image(work.ids()[missing]).frame_id)
        calls.append("map")
        return models

    def adjusting(*arguments: Any, last: bool = False) -> pycolmap.Reconstruction | None:
        calls.append("adjust at last" if last else "adjust")
        return adjust_poses(*arguments, last=last)

    for name in (f"{module}.DIRECT", "panolog.prepare.sfm.mapping.DIRECT"):
        monkeypatch.setattr(name, COUNT - 1)
    monkeypatch.setattr(f"{module}.map_pairs", mapping)
    monkeypatch.setattr(f"{module}.adjust_poses", adjusting)
    return calls


def test_more_than_the_mapper_adjusts_are_adjusted_in_its_place(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What it maps of them drifts: it is adjusted before it is judged, and not mapped again."""
    calls, place = _noted(monkeypatch), square(tmp_path, count=COUNT)
    found = _solve(place)
    assert found.trusted and off(found, place.centers) < 0.01
    assert found.adjusted and calls[:2] == ["map", "adjust"] and calls.count("map") == 1


def test_what_is_added_to_many_or_left_out_is_adjusted_at_last_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without what is left out the tree is in two, so more may seem to contradict: nothing has moved."""
    calls, place, added, left_out = _noted(monkeypatch, missing=13), square(tmp_path, count=COUNT), 13, 5

    def judging(evidence: Evidence, *others: Any) -> list[Contradiction]:
        known = any(left_out in pair.between for pair in evidence.pairs)
        alike = Contradiction((2, 9), 20, 0)
        return find_contradictions(evidence, *others) + [alike] * COUNT * (not known)

    monkeypatch.setattr("panolog.prepare.sfm.consistency.solve.find_contradictions", judging)
    monkeypatch.setattr("panolog.prepare.sfm.consistency.solve._unconfirmed", lambda _: {left_out})
    for module in ("solve", "solution"):  # one may be missing
        monkeypatch.setattr(f"panolog.prepare.sfm.consistency.{module}.SETTLED", 1.5 / COUNT)
    (found,) = parts_of(place)
    assert found.trusted and off(found, place.centers) < 0.01
    assert added in found.found.poses and found.found.poses.keys() == {*range(COUNT)} - {left_out}
    assert calls.count("map") == 2 and calls[-2:] == ["map", "adjust at last"]


def test_points_that_many_see_in_one_direction_are_left_out(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("panolog.prepare.sfm.mapping._MANY", COUNT - 1)
    model = _solve(square(tmp_path, count=COUNT)).model
    centers = np.array([image.projection_center() for image in model.images.values()])
    middle, up = centers.mean(axis=0), np.array([0.0, 0.0, np.linalg.norm(np.ptp(centers, axis=0))])
    tracks = []
    for feature in (0, 1):
        for number in model.reg_image_ids():
            if model.image(number).points2D[feature].has_point3D():
                model.delete_observation(number, feature)
        tracks.append([pycolmap.TrackElement(number, feature) for number in model.reg_image_ids()])
    assert len(centers) == COUNT
    steeple = model.add_point3D(middle + up, pycolmap.Track(tracks[0]))
    before = set(model.points3D)
    cloud = model.add_point3D(middle + 20 * up, pycolmap.Track(tracks[1]))
    assert cloud not in before and steeple in before
    _drop_far(model)
    assert set(model.points3D) == before
    model.add_point3D(middle + 20 * up, pycolmap.Track(tracks[1][1:]))
    _drop_far(model)
    assert len(model.points3D) == len(before) + 1  # of so few it is no work


def test_poses_that_have_drifted_are_adjusted_to_what_agrees(tmp_path: Path) -> None:
    place = square(tmp_path, count=COUNT)
    found, drifted = _solve(place), {}
    for row, (rotation, shift) in found.found.poses.items():
        turn = Rotation.from_euler("z", 0.2 * row, degrees=True).as_matrix()
        center = -rotation.T @ shift + [(row / COUNT) ** 2, 0.0, 0.0]
        drifted[row] = (rotation @ turn.T, -rotation @ turn.T @ center)
    centers = np.array([-rotation.T @ shift for rotation, shift in (drifted[row] for row in range(COUNT))])
    assert drift(centers, place.centers) > 0.2
    part = place.work.with_pairs(found.kept, "pairs.db", range(COUNT))
    with silence_colmap():
        model = adjust_poses(part, found.model, drifted, 2.0)
        others = adjust_poses(part, found.model, {row: drifted[row] for row in range(COUNT - 1)}, 2.0)
    assert model is not None and others is not None
    assert others.num_reg_images() == COUNT - 1
    again = replace(found, model=model, found=posed(model, place.work.ids()))
    assert off(again, place.centers) < 0.05
