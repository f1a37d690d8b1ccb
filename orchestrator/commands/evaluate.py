"""`panolog eval`: the metrics of a run, read where they are known and measured where they are not."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

from panolog.orchestrator.driver.evaluation import Evaluation
from panolog.orchestrator.driver.job import Job, new_evaluation, scene_of
from panolog.orchestrator.run import lock
from panolog.orchestrator.run.folder import RunFolder
from panolog.orchestrator.run.info import read_info
from panolog.scene.errors import InputError
from panolog.scene.ply import ply_header
from panolog.workers.evaluation import EvaluateTask, evaluate
from panolog.workers.events import Progress

Report = dict[str, Any]
Hear = Callable[[Progress], None]


def judge(root: Path, *, model: Path | None, crop_bottom: float | None, device: str, hear: Hear) -> Report:
    """The content of metrics.json for a run's merged model, or for another PLY on its held-out panoramas.

    What the run has measured with the same crop is read. Otherwise it is measured now; metrics.json and
    pictures are written only for the merged model with the run's own crop, while no driver is at work.

    Args: model, another PLY; crop_bottom, fraction of the height, None = the run's; hear is told of progress.
    Raises InputError if there is no run, no model yet or no such PLY, or the scene has changed.
    """
    folder = RunFolder(root)
    info = read_info(folder)
    crop = info.config.eval.crop_bottom if crop_bottom is None else crop_bottom
    ply = model or folder.point_cloud
    if not ply.exists():
        raise InputError(f"{ply}: does not exist" + ("" if model else " yet; see `panolog status`"))
    if model is None and (known := _known(folder, crop)) is not None:
        return known
    job = Job(folder, scene_of(info), info.config)
    if model is not None or crop != info.config.eval.crop_bottom:
        evaluation = Evaluation(job.scene, ply, job.width, crop, None)
        return _measure(evaluation, job.near, device, hear).report()
    with lock.hold(folder.lock):
        evaluation = _measure(new_evaluation(job), job.near, device, hear)
        evaluation.save(folder)
        return evaluation.report()


def _known(folder: RunFolder, crop: float) -> Report | None:
    """metrics.json, if it is about the merged model as it is and about this crop."""
    if not folder.metrics.exists():
        return None
    stored: Report = json.loads(folder.metrics.read_bytes())
    count, _ = ply_header(folder.point_cloud)
    return stored if (stored["gaussians"], stored["crop_bottom"]) == (count, crop) else None


def _measure(evaluation: Evaluation, near: float, device: str, hear: Hear) -> Evaluation:
    task = EvaluateTask(
        scene=evaluation.scene,
        views=evaluation.scene.test,
        width=evaluation.width,
        gaussians=evaluation.ply,
        near=near,
        crop_bottom=evaluation.crop_bottom,
        device=device,
    )
    for event in evaluate(task):
        evaluation.add(event)
        if isinstance(event, Progress):
            hear(event)
    return evaluation
