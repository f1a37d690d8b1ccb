"""Run folders that differ in one thing, for comparisons."""

from collections.abc import Mapping, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from panolog.orchestrator.runs.database import Database
from panolog.orchestrator.runs.folder import RunFolder, write_json
from panolog.orchestrator.runs.records import (
    BlockPlan,
    EvaluationSaved,
    Merged,
    ModelSaved,
    Outcome,
    PlanSaved,
    Progressed,
    Record,
    RunEnded,
)
from panolog.workers.tasks import COARSE, EVAL, TaskId
from tests.orchestrator.history import BEGAN, begun, started

BLOCKS = (TaskId.block(0), TaskId.block(1))
VALUES = {"a.jpg": 20.0, "b.jpg": 24.0, "c.jpg": 28.0}  # WS-PSNR by panorama
_START = 1_000_000.0  # seconds since the epoch


def metrics(values: Mapping[str, float] = VALUES, **head: Any) -> dict[str, Any]:
    """The content of metrics.json with a WS-PSNR, and an LPIPS that falls as it grows, for each panorama."""
    views = {name: {"ws_psnr": value, "lpips": 1 - value / 50} for name, value in values.items()}
    return {"width": 64, "crop_bottom": 0.0, "gaussians": 700, "left_out": {}} | head | {"views": views}


def write(
    root: Path,
    *,
    records: Sequence[tuple[float, Record]] | None = None,
    measured: Mapping[str, Any] | None = None,
    fingerprint: str = "f" * 64,
    **config: Any,
) -> RunFolder:
    """A run folder with records at so many seconds after its start; by default those of a finished run."""
    settings = {"iterations": 100, "device": "cpu"} | config
    folder = begun(root, scene="/scenes/town", fingerprint=fingerprint, **settings)
    with closing(Database(folder.database)) as database:
        database.store([(_START + at, record) for at, record in (finished() if records is None else records)])
    if measured is not None:
        folder.make(folder.metrics.parent)
        write_json(folder.metrics, measured)
    return folder


def progressed(task: TaskId, iteration: int, gaussians: int, loss: float = 0.1) -> Progressed:
    """A task's progress, of 100 iterations."""
    return Progressed(task, iteration, 100, 4.0, loss, 21.0, gaussians, 1_000, 10 * gaussians)


def finished(node: str = "host") -> list[tuple[float, Record]]:
    """A run whose Stage I takes a minute, and whose two blocks train a minute each, one after the other."""
    first, second = BLOCKS
    plan = tuple(BlockPlan(number, 2, 250, train=True) for number in (0, 1))
    return [
        (0, BEGAN),
        (0, started(COARSE, node=node)),
        (30, progressed(COARSE, 50, 400, 0.3)),
        (60, progressed(COARSE, 100, 500, 0.2)),
        (60, ModelSaved(COARSE, "coarse/model.ply", 500, 9_000, 100, 60.0)),
        (60, PlanSaved("partition/plan.json", plan)),
        (60, started(first, node=node)),
        (90, progressed(first, 50, 300, 0.2)),
        (120, progressed(first, 100, 340, 0.1)),
        (120, ModelSaved(first, "blocks/000/model.ply", 340, 9_000, 100, 60.0)),
        (120, started(second, node=node)),
        (150, progressed(second, 50, 320, 0.4)),
        (180, progressed(second, 100, 360, 0.3)),
        (180, ModelSaved(second, "blocks/001/model.ply", 360, 9_000, 100, 60.0)),
        (181, Merged("point_cloud.ply", 700, 10, 12_345, 1.0)),
        (181, started(EVAL, node=node)),
        (190, EvaluationSaved("eval/metrics.json", {"ws_psnr": 24.0})),
        (190, RunEnded(Outcome.DONE)),
    ]


def write_picture(folder: RunFolder, view: str, render: int, truth: int, width: int = 64) -> None:
    """A picture of a held-out panorama: a grey render above its ground truth."""
    picture = np.full((width + 4, width, 3), 255, np.uint8)
    picture[: width // 2], picture[-width // 2 :] = render, truth
    folder.images.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(folder.picture(view)), picture)
