"""`panolog eval`: the metrics of a run, read if they are stored and measured if not."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from panolog.orchestrator.cli.commands.models import Axes, as_ply, frame_in, size_of
from panolog.orchestrator.engine.driver.job import Job, Specs, new_evaluation
from panolog.orchestrator.engine.scheduling.pool import InProcess
from panolog.orchestrator.engine.stages.evaluation import Evaluation
from panolog.orchestrator.engine.stages.scenes import scene_of
from panolog.orchestrator.runs import lock
from panolog.orchestrator.runs.folder import RunFolder, command_line, read_object
from panolog.orchestrator.runs.info import read_info
from panolog.orchestrator.watch.views.terminal import metrics_line
from panolog.renderer.process import choose_device
from panolog.scene.errors import InputError
from panolog.scene.ply import ply_exact, ply_header
from panolog.scene.write import StageProgress
from panolog.workers.evaluation import EvaluateSpec
from panolog.workers.tasks import NOTHING_HELD_OUT, Progress

Report = dict[str, Any]
_SAID = {"views", "mean", "bytes", "lpips_reason"}  # of metrics.json
_MOST = 100_000_000  # bytes of a file
_FITTED = 0.3  # dB: from here on a fit of colours is worth a line


def evaluate_run(
    root: Path,
    *,
    model: Path | None,
    axes: Axes = "export",
    crop_bottom: float | None,
    seams: bool = False,
    device: str | None,
    progress: StageProgress,
) -> Report:
    """The content of metrics.json for a run's merged model, or for another model on its held-out panoramas.

    Metrics that the run has measured with the same crop are read. Otherwise they are measured now;
    metrics.json, seams.json and pictures are written only for the merged model with the run's own crop, while
    no driver runs.

    Args: model, another PLY, SOG, SPZ or compressed PLY; axes of it if it is no PLY; crop_bottom, fraction of
    the height, None = the run's; seams, whether the report has the content of seams.json too, as "seams";
    device, as `choose_device`.
    Raises InputError if there is no run, no model yet or no such PLY, the scene has changed, or there are no
    seams to measure.
    """
    if seams and (model or crop_bottom is not None):
        raise InputError("--seams is of the run's own model: leave out --model and --crop-bottom")
    device, folder = choose_device(device), RunFolder(root)
    info = read_info(folder)
    crop = info.config.eval.crop_bottom if crop_bottom is None else crop_bottom
    ply = model or folder.point_cloud
    if not ply.exists():
        hint = "" if model else f" yet; see `{command_line('status', root)}`"
        raise InputError(f"{ply}: does not exist{hint}")
    if (
        model is None
        and (known := _known(folder, crop)) is not None
        and (not seams or "faces" in read_object(folder.seams, _MOST))
    ):
        return known | (_read_seams(folder) if seams else {})
    job = Job(folder, scene_of(info, folder), info.config.model_copy(update={"device": device})).learnt
    specs = Specs(job, InProcess())
    if model is not None or crop != info.config.eval.crop_bottom:
        exact = folder.point_cloud.is_file() and ply_exact(folder.point_cloud)
        with as_ply(ply, lambda: frame_in(ply, job.scene, axes), exact=exact) as file:
            evaluation, spec = Evaluation(job.scene, file, job.width, crop, None), specs.evaluate(file, crop)
            return _measure(spec, evaluation, progress).report() | {"bytes": size_of(ply)}
    if seams and not specs.faces:
        raise InputError(f"{root}: has no faces between blocks that cameras see from both sides")
    with lock.hold(folder.lock):
        spec = specs.evaluate(ply, crop, specs.faces)
        evaluation = new_evaluation(job, len(spec.faces))
        _measure(spec, evaluation, progress).save(folder)
        return evaluation.report() | (_read_seams(folder) if seams else {})


def lines(report: Report) -> Iterator[str]:
    """A report for people."""
    for name, metrics in report["views"].items():
        yield f"{name}: {metrics_line(metrics)}"
    yield from report.get("left_out", {}).values()
    yield f"mean: {metrics_line(report['mean'])}" if report["views"] else NOTHING_HELD_OUT
    plain, fitted = (report["mean"].get(key) for key in ("psnr", "cc_psnr"))
    if plain is not None and fitted is not None and fitted > plain + _FITTED:
        ws = report["mean"]["cc_ws_psnr"]
        yield f"mean after a fit of colours: PSNR {fitted:.2f} dB, WS-PSNR {ws:.2f} dB"
    if there := report.get("pose_fit", {}).get("mean"):
        yield f"mean at fitted poses, {there['pixels']:.2f} pixels away: {metrics_line(there)}"
    yield f"{report['gaussians']:,} Gaussians, {report['bytes']:,} bytes"
    for face in report.get("seams", {}).get("faces", ()):
        yield _seam_line(face)


def _seam_line(face: Report) -> str:
    """A face between two blocks."""
    name = "seam between blocks {} and {}".format(*face["blocks"])
    if face["seam"] is None:
        return f"{name}: not measured"
    merged, coarse = face["merged"], face["coarse"]
    return (
        f"{name}: {face['seam']:.2f} times that of Stage I (steps {merged['step_ratio']:.2f} times those"
        f" within the blocks, in Stage I {coarse['step_ratio']:.2f}; errors {merged['error_ratio']:.2f})"
    )


def _known(folder: RunFolder, crop: float) -> Report | None:
    """metrics.json, if it was measured on the present merged model with this crop, and is whole."""
    stored = read_object(folder.metrics, _MOST)
    count, _ = ply_header(folder.point_cloud)
    same = (stored.get("gaussians"), stored.get("crop_bottom")) == (count, crop)
    return stored if same and stored.keys() >= _SAID else None


def _read_seams(folder: RunFolder) -> Report:
    return {"seams": read_object(folder.seams, _MOST)}


def _measure(spec: EvaluateSpec, evaluation: Evaluation, progress: StageProgress) -> Evaluation:
    for event in spec.run():
        evaluation.add(event)
        if isinstance(event, Progress):
            progress("eval", event.iteration, event.iterations)
    return evaluation
