import copy
import json
import pickle
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from panolog.partition.audit import audit
from panolog.partition.bounds import aabb
from panolog.partition.cells import Cells, Cuts, Grid
from panolog.partition.contraction import contract
from panolog.partition.plan import PartitionConfig, Plan, make_plan
from panolog.partition.scores import read_scores
from panolog.scene.errors import InputError

CENTERS = np.array([[float(x), 0.0, 0.1 * x] for x in range(6)])
GRID = Grid((2, 1, 2))


def plan(scores: Any = None) -> Plan:
    generator = np.random.default_rng(0)
    means = generator.normal(size=(500, 3)) * 20
    given = generator.random((len(CENTERS), GRID.count)) if scores is None else scores
    return planned(CENTERS, means, given, GRID)


def planned(centers: Any, means: Any, scores: Any, cells: Cells, **config: Any) -> Plan:
    """A plan for cameras that are the second panorama of a scene and all after it."""
    rows = range(1, len(centers) + 1)
    names = [f"pano{row}.jpg" for row in rows]
    return make_plan(centers, means, scores, cells, PartitionConfig(**config), rows=rows, names=names)


def test_a_camera_on_a_face_belongs_to_the_upper_cell() -> None:
    centers = np.array([[-1.0, 0, 0], [0, 0, 0], [1, 0, 0]])
    made = planned(centers, centers, np.zeros((3, 2)), Grid((2, 1, 1)))
    assert made.camera_blocks.tolist() == [0, 1, 1]
    assert made.rows == (1, 2, 3)
    assert made.gaussians.tolist() == [1, 2]


def test_blocks_get_rows_of_the_scene() -> None:
    made = plan()
    assigned = made.assignment.assigned.toarray()
    for block in range(GRID.count):
        assert made.cameras(block) == tuple(int(k) + 1 for k in np.flatnonzero(assigned[:, block]))
        inside = made.cell(block).contains(CENTERS)
        np.testing.assert_array_equal(inside, made.camera_blocks == block)
    assert made.gaussians.sum() == 500


def test_a_block_is_compared_on_as_many_of_its_cameras_as_of_others() -> None:
    scores = np.ones((6, GRID.count))
    scores[:, 0] = [0.9, 0.1, 0.5, 0.0, 0.7, 0.5]
    made, first = plan(scores), scores[:, 0]
    assert made.cameras(0) == (1, 2, 3)  # by position and, the first, by its score
    assert made.compared(0, first, 1) == (1, 5)
    assert made.compared(0, first, 2) == made.compared(0, first, 8) == (1, 3, 5, 6)  # one sees nothing of it
    assert made.compared(0, first, 0) == () == made.compared(1, scores[:, 1], 8)  # all train the other


def test_plan_survives_its_file() -> None:
    stored = json.loads(json.dumps(plan().to_json(), allow_nan=False))
    again = Plan.from_json(stored)
    assert again.to_json() == plan().to_json()
    assert stored["version"] == 2
    reasons = {reason for camera in stored["cameras"] for reason in camera["assigned"].values()}
    assert reasons == {"geometry", "gradient", "both"}


def test_a_plan_of_many_blocks_is_small_in_its_file_and_in_tasks() -> None:
    """Neither grows with cameras times blocks: scores of all pairs are written once, elsewhere."""
    centers = np.random.default_rng(0).uniform(-9, 9, (400, 3))
    made = planned(centers, centers, np.random.default_rng(1).random((400, 1_000)) ** 99, Grid((10, 10, 10)))
    per_pair = 1.0  # bytes: a digit of each score
    assert len(json.dumps(made.to_json())) < 400 * 1_000 * per_pair
    assert len(pickle.dumps(made)) < 400 * 1_000 * per_pair


def test_a_plan_of_version_1_opens(tmp_path: Path) -> None:
    """A plan.json of version 1 has the scores in itself, and its scores.npz has them densely."""
    scores = np.random.default_rng(2).random((6, GRID.count)) * [1, 0, 1, 1]
    made = plan(scores)
    older = made.to_json() | {"version": 1}
    for camera, row in zip(older["cameras"], scores, strict=True):
        camera["scores"] = row.tolist()
    again = Plan.from_json(json.loads(json.dumps(older)))
    assert again.to_json() == made.to_json()
    np.savez(tmp_path / "scores.npz", cameras=np.array(made.rows), scores=scores)
    read = read_scores(tmp_path / "scores.npz", again.rows, again.grid.count)
    np.testing.assert_array_equal(read.toarray(), scores)


def test_a_plan_with_parts_of_the_box_survives_its_file() -> None:
    made = planned(CENTERS, CENTERS, np.zeros((6, 4)), Grid((4, 1, 1), "box"))
    stored = made.to_json()
    assert [block["contracted"]["upper"][0] for block in stored["blocks"]] == [0.375, 0.5, 0.625, 1.0]
    assert Plan.from_json(stored).grid == made.grid
    older = {key: value for key, value in plan().to_json().items() if key != "cells"}
    assert Plan.from_json(older).grid == plan().grid


def test_a_plan_of_balanced_blocks_survives_its_file() -> None:
    cells = Cuts((("x", 0.5, 2), ("y", 0.25, 1), ("y", 0.625, 1)))
    made = planned(CENTERS, CENTERS, np.zeros((6, 4)), cells, cuts=cells.cuts)
    stored = json.loads(json.dumps(made.to_json()))
    assert stored["grid"] is None
    assert stored["cuts"] == [["x", 0.5, 2], ["y", 0.25, 1], ["y", 0.625, 1]]
    assert [block["contracted"]["upper"][:2] for block in stored["blocks"]] == [
        [0.5, 0.25],
        [0.5, 1.0],
        [1.0, 0.625],
        [1.0, 1.0],
    ]
    again = Plan.from_json(stored)
    assert (again.grid, again.config) == (cells, made.config)
    with pytest.raises(
        InputError, match=r"contradicts itself: the cut x = 1\.5 with 2 of 4 blocks below has an"
    ):
        Plan.from_json(_change(stored, ["cuts", 0, 1], 1.5))


def _change(data: dict[str, Any], path: list[Any], value: Any) -> dict[str, Any]:
    changed = copy.deepcopy(data)
    *way, last = path
    place: Any = changed
    for key in way:
        place = place[key]
    place[last] = value
    return changed


@pytest.mark.parametrize(
    ("path", "value", "words"),
    [
        (["version"], 3, "version"),
        (["cameras", 0, "center", 1], float("nan"), "center"),
        (["extra"], 1, "extra"),
        (["grid"], [2, 0, 2], "at least 1"),
        (["aabb", "lower"], [1e9, 0, 0], "lower < upper"),
        (["blocks", 0, "cameras"], [], "'blocks'"),
        (["cameras", 2, "block"], 3, "'cameras'"),
        (["cameras", 2, "assigned"], {}, "'blocks'"),
        (["cameras", 2, "assigned", 9], "gradient", "contradicts"),
        (["cameras", 2, "assigned", -1], "both", "contradicts"),
        (["tau_grad"], 2.0, "contradicts"),
        (["blocks"], [], "contradicts"),
    ],
)
def test_a_file_that_is_wrong_is_refused_with_the_place(path: list[Any], value: Any, words: str) -> None:
    with pytest.raises(InputError, match=words) as refused:
        Plan.from_json(_change(plan().to_json(), path, value))
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize("data", [None, [], "plan", {}])
def test_something_else_is_refused(data: object) -> None:
    with pytest.raises(InputError, match="not a plan"):
        Plan.from_json(data)


def test_scores_of_another_grid_are_refused() -> None:
    with pytest.raises(ValueError, match="scores"):
        plan(scores=np.ones((6, 3)))


def test_audit_names_blocks_without_cameras_and_idle_cameras() -> None:
    centers = np.array([[0.0, 0, 0], [0.1, 0, 0]])
    box = aabb(centers, 5.0)
    grid = Grid((1, 1, 3))
    means = np.array([[0.0, 0, 100 * box.upper[2]]])
    made = planned(centers, means, np.zeros((2, 3)), grid)
    lines = audit(made, np.zeros((2, 3)))
    assert "3 blocks (1x1x3)" in lines[0] and "2 cameras, 1 Gaussians" in lines[0]
    assert any("block 0 has no Gaussians and is skipped" in line for line in lines)
    assert any("block 2 has no camera: its 1 Gaussians stay" in line for line in lines)
    assert any(line.startswith("2 cameras train no block") for line in lines)


def test_blocks_with_few_cameras_keep_what_stage_one_made() -> None:
    centers = np.array([[-3.0, 0, 0], [1, 0, 0], [2, 0, 0], [3, 0, 0]])
    made = planned(centers, centers, np.zeros((4, 2)), Grid((2, 1, 1)))
    assert made.trained.tolist() == [False, True]
    assert "block 0 has 1 camera, fewer than partition.min_cameras=3: its 1 Gaussians stay as they were" in (
        "\n".join(audit(made, np.zeros((4, 2))))
    )
    empty = planned(centers, centers[:1], np.zeros((4, 2)), Grid((2, 1, 1)))
    assert empty.trained.tolist() == [False, False]  # the other has no Gaussians
    stored = json.loads(json.dumps(made.to_json()))
    assert Plan.from_json(stored).trained.tolist() == [False, True]
    del stored["min_cameras"]  # of a version that trained all blocks with a camera
    assert Plan.from_json(stored).trained.tolist() == [True, True]


def test_blocks_with_next_to_no_gaussians_keep_what_stage_one_made() -> None:
    centers = np.array([[x, 0.0, 0] for x in (-3, -2, -1, 1, 2, 3)])
    means = np.concatenate([np.repeat(centers[3:], 800, axis=0), centers[:1].repeat(12, axis=0)])
    made = planned(centers, means, np.zeros((6, 2)), Grid((2, 1, 1)))
    assert made.gaussians.tolist() == [12, 2400] and made.trained.tolist() == [False, True]
    (line,) = (line for line in audit(made, np.zeros((6, 2))) if "min_share" in line)
    assert line == (
        "block 0 has 12 Gaussians, not more than partition.min_share=0.01 of the mean: they stay as they were"
        " after Stage I"
    )
    stored = json.loads(json.dumps(made.to_json()))
    assert Plan.from_json(stored).trained.tolist() == [False, True]
    del stored["min_share"]  # of a version that trained all blocks with a Gaussian
    assert Plan.from_json(stored).trained.tolist() == [True, True]


def test_audit_reports_uneven_blocks() -> None:
    scores = np.ones((6, 4))
    made = plan(scores)
    uneven = replace(made, gaussians=np.array([1000, 10, 10, 10]))
    assert any("10 to 1,000 Gaussians" in line for line in audit(uneven, scores))
    assert not any("uneven" in line for line in audit(made, scores) if "cameras" in line)


def sharing(others: list[float], tau_grad: float = 0.8) -> list[str]:
    """What the audit says of gradients: each camera scores 1 where it is, and `others` elsewhere."""
    centers = np.array([[float(x), 0.0, 0.0] for x in range(len(others))])
    grid = Grid((2, 1, 1))
    here = grid.block_of(contract(centers, aabb(centers, 5.0)))
    scores = np.where(here[:, None] == np.arange(2), 1.0, np.array(others)[:, None])
    made = planned(centers, centers, scores, grid, tau_grad=tau_grad)
    return [line for line in audit(made, scores) if line.startswith("gradients add")]


def test_audit_names_the_threshold_at_which_blocks_overlap() -> None:
    (line,) = sharing([0.35, 0.35, 0.15, 0.15, 0.15, 0.035, 0.01, 0.0, 0.0, 0.0])
    assert "add 0 % of the assignments at partition.tau_grad=0.8" in line
    assert "at 0.1 a camera would train 1.50 blocks" in line
    (line,) = sharing([0.35, 0.0, 0.0, 0.0])  # 1.5 is out of reach
    assert "at 0.3 a camera would train 1.25 blocks" in line
    (line,) = sharing([0.0, 0.0, 0.0, 0.0])
    assert "no more at lower values" in line


def test_audit_is_silent_where_gradients_add_enough_or_nothing_is_wanted() -> None:
    assert len(sharing([0.9] + [0.0] * 19)) == 1  # 1 of 21 assignments
    assert sharing([0.9] + [0.0] * 18) == []  # 1 of 20: 5 %
    assert sharing([0.5] * 4, tau_grad=1.0) == []
