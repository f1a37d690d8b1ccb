"""`panolog eval`: the metrics of a run, read if they are stored and measured if not."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from panolog.orchestrator.driver.evaluation import Evaluation
from panolog.orchestrator.driver.job import Job, Specs, new_evaluation, scene_of
from panolog.orchestrator.resources.pool import InProcess
from panolog.orchestrator.run import lock
from panolog.orchestrator.run.folder import RunFolder, command_line
from panolog.orchestrator.run.info import read_info
from panolog.orchestrator.views.terminal import metrics_line
from panolog.renderer.process import choose_device
from panolog.scene.errors import InputError
from panolog.scene.ply import ply_header
from panolog.scene.write import StageProgress
from panolog.workers.events import Progress

Report = dict[str, Any]


def evaluate_run(
    root: Path,
    *,
    model: Path | None,
    crop_bottom: float | None,
    device: str | None,
    progress: StageProgress,
) -> Report:
    """The content of metrics.json for a run's merged model, or for another PLY on its held-out panoramas.

    Metrics that the run has measured with the same crop are read. Otherwise they are measured now;
    metrics.json and pictures are written only for the merged model with the run's own crop, while no driver
    runs.

    Args: model, another PLY; crop_bottom, fraction of the height, None = the run's; device, as
    `choose_device`.
    Raises InputError if there is no run, no model yet or no such PLY, or the scene has changed.
    """
    device, folder = choose_device(device), RunFolder(root)
    info = read_info(folder)
    crop = info.config.eval.crop_bottom if crop_bottom is None else crop_bottom
    ply = model or folder.point_cloud
    if not ply.exists():
        hint = "" if model else f" yet; see `{command_line('status', root)}`"
        raise InputError(f"{ply}: does not exist{hint}")
    if model is None and (known := _known(folder, crop)) is not None:
        return known
    job = Job(folder, scene_of(info), info.config.model_copy(update={"device": device}))
    if model is not None or crop != info.config.eval.crop_bottom:
        evaluation = Evaluation(job.scene, ply, job.width, crop, None)
        return _measure(job, evaluation, progress).report()
    with lock.hold(folder.lock):
        evaluation = _measure(job, new_evaluation(job, 0), progress)
        evaluation.save(folder)
        return evaluation.report()


def lines(report: Report) -> Iterator[str]:
    """A report for people."""
    for name, metrics in report["views"].items():
        yield f"{name}: {metrics_line(metrics)}"
    yield from report.get("left_out", {}).values()
    yield f"mean: {metrics_line(report['mean'])}"
    yield f"{report['gaussians']:,} Gaussians, {report['bytes']:,} bytes"


def _known(folder: RunFolder, crop: float) -> Report | None:
    """metrics.json, if it was measured on the present merged model with this crop."""
    if not folder.metrics.exists():
        return None
    stored: Report = json.loads(folder.metrics.read_bytes())
    count, _ = ply_header(folder.point_cloud)
    return stored if (stored["gaussians"], stored["crop_bottom"]) == (count, crop) else None


def _measure(job: Job, evaluation: Evaluation, progress: StageProgress) -> Evaluation:
    for event in Specs(job, InProcess()).evaluate(evaluation.ply, evaluation.crop_bottom).run():
        evaluation.add(event)
        if isinstance(event, Progress):
            progress("eval", event.iteration, event.iterations)
    return evaluation
