from pathlib import Path

import cv2
import numpy as np
import pytest

from panolog.orchestrator.views.plan_picture import write_plan_picture
from panolog.partition.cells import Grid
from panolog.partition.plan import PartitionConfig, make_plan


@pytest.mark.parametrize("grid", [Grid((2, 1, 1)), Grid((3, 2, 3))])
@pytest.mark.parametrize("points", [0, 500])
def test_a_picture_appears(tmp_path: Path, grid: Grid, points: int) -> None:
    random = np.random.default_rng(0)
    centers = random.normal(size=(12, 3)) * [5, 0.01, 9]
    cloud = (random.normal(size=(points, 3)) * 20).astype(np.float32)
    scores, names = random.random((12, grid.count)), [f"{i}.jpg" for i in range(12)]
    plan = make_plan(centers, cloud, scores, grid, PartitionConfig(), rows=range(12), names=names)
    write_plan_picture(tmp_path / "plan.png", plan, cloud)
    picture = cv2.imread(str(tmp_path / "plan.png"))
    assert picture is not None
    assert min(picture.shape[:2]) > 500
    assert picture.std() > 5
    assert [path.name for path in tmp_path.iterdir()] == ["plan.png"]
