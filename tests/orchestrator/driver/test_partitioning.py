"""Which blocks of a plan a run trains."""

from pathlib import Path

import numpy as np

from panolog.orchestrator.driver.partitioning import plan_records
from panolog.orchestrator.run.folder import RunFolder
from panolog.orchestrator.run.records import Noticed, PlanSaved
from panolog.partition.cells import Grid
from panolog.partition.plan import PartitionConfig, make_plan


def test_a_block_of_one_camera_is_not_trained_and_a_notice_says_so(tmp_path: Path) -> None:
    centers = np.array([[-3.0, 0, 0], [1, 0, 0], [2, 0, 0], [3, 0, 0]])
    names = [f"{row}.jpg" for row in range(4)]
    for least, trained in ((3, [False, True]), (1, [True, True])):
        config = PartitionConfig(min_cameras=least)
        grid = Grid((2, 1, 1))
        plan = make_plan(centers, centers, np.zeros((4, 2)), grid, config, rows=range(4), names=names)
        *notices, saved = plan_records(RunFolder(tmp_path), plan)
        assert isinstance(saved, PlanSaved)
        assert [block.train for block in saved.blocks] == trained
        lines = [record.message for record in notices if isinstance(record, Noticed)]
        assert any("block 0 has 1 camera, fewer than" in line for line in lines) == (least > 1)
