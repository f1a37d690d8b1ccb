"""Districts of Stage I and their union; which blocks of a plan a run trains. Without Ray."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from scipy.sparse import csr_array

from panolog.orchestrator.engine.stages.partitioning import plan_records
from panolog.orchestrator.runs.folder import RunFolder
from panolog.orchestrator.runs.records import ModelSaved, Noticed, PlanSaved
from panolog.partition.cells import Grid
from panolog.partition.plan import PartitionConfig, make_plan
from panolog.scene.ply import read_ply
from panolog.workers.events import Event, Trained
from panolog.workers.merge import retained
from panolog.workers.specs import TaskSpec
from panolog.workers.tasks import COARSE, TaskId
from panolog.workers.training.trainer import TrainSpec
from tests.orchestrator.fakes import Harness, trained, well

BOTH = TaskId.district(0), TaskId.district(1)


def shifted(spec: TaskSpec) -> Iterator[Event]:
    """All goes well, and colours are those of the district."""
    if isinstance(spec, TrainSpec) and spec.cell is None:
        model = trained(spec)
        yield Trained(spec.task, replace(model, sh0=model.sh0 + spec.task.number), 2, 0.1)
    else:
        yield from well(spec)


def halves(folder: Path) -> Harness:
    folder.mkdir(exist_ok=True)
    return Harness(folder, districts=2, overlap=0.1, partition={"min_cameras": 2, "rho_tri": 0.1})


def test_districts_are_trained_apart_and_joined(tmp_path: Path) -> None:
    """Each gives what is in its cell, both the mean of their skies."""
    harness = halves(tmp_path)
    state, train = harness.drive(shifted), set(harness.job.scene.train)
    assert state.outcome == "done"
    assert harness.tasks[:2] == list(BOTH) and COARSE not in harness.tasks
    views = [set(harness.trainings(task)[0].views) for task in BOTH]
    assert views[0] | views[1] == train and views[0] != train != views[1]
    districts = harness.job.districts
    assert districts is not None
    coarse, models = read_ply(harness.folder.model(COARSE)), [read_ply(harness.folder.model(t)) for t in BOTH]
    kept = [retained(model, districts.cell(i), 0.0) for i, model in enumerate(models)]
    assert len(coarse) - coarse.sky == len(kept[0]) + len(kept[1]) == len(models[0]) - models[0].sky
    torch.testing.assert_close(coarse.sh0[coarse.scene], torch.cat([kept[0].sh0, kept[1].sh0]))
    torch.testing.assert_close(coarse.sh0[coarse.scene.stop :], models[0].sh0[models[0].scene.stop :] + 0.5)
    saved = [record for record in harness.records(ModelSaved) if record.task == COARSE]
    assert [(record.gaussians, record.path) for record in saved] == [(len(coarse), "coarse/model.ply")]


def test_a_sky_that_has_lost_rows_does_not_count(tmp_path: Path) -> None:
    harness = halves(tmp_path)

    def script(spec: TaskSpec) -> Iterator[Event]:
        for event in shifted(spec):
            if isinstance(event, Trained) and spec.task == BOTH[0]:
                model = event.gaussians
                yield replace(event, gaussians=model.select(torch.arange(len(model)) < len(model) - 1))
            else:
                yield event

    assert harness.drive(script).outcome == "done"
    coarse, second = (read_ply(harness.folder.model(task)) for task in (COARSE, BOTH[1]))
    assert coarse.sky == second.sky == 2
    torch.testing.assert_close(coarse.sh0[coarse.scene.stop :], second.sh0[second.scene.stop :])


def test_a_block_of_one_camera_is_not_trained_and_a_notice_says_so(tmp_path: Path) -> None:
    centers = np.array([[-3.0, 0, 0], [1, 0, 0], [2, 0, 0], [3, 0, 0]])
    names = [f"{row}.jpg" for row in range(4)]
    for least, train in ((3, [False, True]), (1, [True, True])):
        config = PartitionConfig(min_cameras=least)
        grid = Grid((2, 1, 1))
        scores = csr_array((4, 2))
        plan = make_plan(centers, centers, scores, grid, config, rows=range(4), names=names)
        *notices, saved = plan_records(RunFolder(tmp_path), plan, scores)
        assert isinstance(saved, PlanSaved)
        assert [block.train for block in saved.blocks] == train
        lines = [record.message for record in notices if isinstance(record, Noticed)]
        assert any("block 0 has 1 camera, fewer than" in line for line in lines) == (least > 1)
