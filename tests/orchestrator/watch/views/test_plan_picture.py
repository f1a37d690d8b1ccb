"""plan.png: nothing over anything else, and no large empty part, whatever the shape of the scene."""

from itertools import combinations
from pathlib import Path

import cv2
import numpy as np
import pytest

from panolog.orchestrator.watch.views.plan_picture import plan_figure, write_plan_picture
from panolog.partition.cells import Grid
from panolog.partition.plan import PartitionConfig, Plan, make_plan

# Blocks, and half the extent of the cameras.
SHAPES = {
    "a long street": ((4, 1, 1), (80, 4, 0.2)),
    "a square": ((2, 2, 1), (20, 20, 0.2)),
    "one block": ((1, 1, 1), (20, 14, 0.2)),
    "many blocks": ((4, 1, 4), (40, 0.3, 40)),
    "a tall scene": ((1, 4, 1), (4, 60, 0.2)),
    "layers": ((3, 2, 3), (30, 20, 2)),
}


def plan_of(blocks: tuple[int, int, int], extent: tuple[float, float, float], points: int) -> Plan:
    random, grid = np.random.default_rng(0), Grid(blocks)
    centers = random.uniform(-1, 1, (40, 3)) * extent
    cloud = random.uniform(-1.2, 1.2, (points, 3)) * extent
    scores, names = random.random((40, grid.count)) ** 6, [f"{i}.jpg" for i in range(40)]
    return make_plan(centers, cloud, scores, grid, PartitionConfig(), rows=range(40), names=names)


@pytest.mark.parametrize("shape", SHAPES)
def test_the_picture_is_full_and_nothing_lies_over_anything_else(tmp_path: Path, shape: str) -> None:
    blocks, extent = SHAPES[shape]
    plan = plan_of(blocks, extent, 500)
    cloud = np.random.default_rng(1).uniform(-1.2, 1.2, (0 if shape == "a square" else 500, 3)) * extent
    write_plan_picture(tmp_path / "plan.png", plan, cloud)
    picture = cv2.imread(str(tmp_path / "plan.png"))
    assert picture is not None
    assert [path.name for path in tmp_path.iterdir()] == ["plan.png"]
    used = (picture < 250).any(axis=2)
    assert (used.mean(axis=1) > 0.5).mean() > 0.65  # rows with the map across them
    assert (used.mean(axis=0) > 0.5).mean() > 0.85  # columns
    figure = plan_figure(plan, cloud)
    figure.draw_without_rendering()
    (axes,) = figure.axes
    whole = axes.get_tightbbox()
    assert whole is not None
    assert figure.get_suptitle().endswith("), 40 cameras")
    (legend,) = figure.legends
    assert not legend.get_window_extent().overlaps(whole)
    assert legend.get_window_extent().x0 >= 0
    assert legend.get_window_extent().x1 <= figure.bbox.width
    assert whole.y1 < figure.texts[0].get_window_extent().y0  # the title
    boxes = [patch.get_window_extent() for label in axes.texts if (patch := label.get_bbox_patch())]
    assert len(boxes) >= min(4, plan.grid.count)
    assert not any(a.overlaps(b) for a, b in combinations(boxes, 2))
    pair = [k for k in range(3) if k != int(np.argmin(np.ptp(plan.centers, axis=0)))]
    cameras = axes.transData.transform(plan.centers[:, pair])
    assert not any(box.contains(*camera) for box in boxes for camera in cameras)
