"""A comparison of runs as JSON: what `panolog compare --json` prints, the dashboard sends, and pages show."""

from typing import Any

from pydantic import Field

from panolog.orchestrator.watch.views.summary import Text, ViewModel

MOST = 8  # runs of a comparison: as many as there are colours that differ enough
METRICS = ("ws_psnr", "psnr", "ssim", "ws_ssim", "lpips")  # in the order in which they are shown
LOWER_IS_BETTER = frozenset({"lpips"})


class StageTime(ViewModel):
    """A stage of a run, with the seconds in which a driver was at work on it."""

    name: str
    label: str
    seconds: float | None


class Trained(ViewModel):
    """Iterations of all tasks of a kind: done and in all."""

    iteration: int
    iterations: int


class MetricView(ViewModel):
    """A metric of a run: its mean over the held-out panoramas, and compared with the first run.

    `difference` is that of the means over the panoramas that both runs have measured; in `better` and `worse`
    of these `panoramas` the run has a better and a worse value. None where that cannot be compared.
    """

    mean: float | None
    difference: float | None = None
    panoramas: int | None = None
    better: int | None = None
    worse: int | None = None


class MeasuredView(ViewModel):
    """How the metrics of a run were measured: what metrics.json says besides the metrics."""

    width: int | None  # pixels
    crop_bottom: float | None  # fraction of the height
    detail: float | None  # pixels, of levels of detail; None without
    panoramas: int
    left_out: int  # panoramas that could not be decoded
    gaussians: int | None  # of the model that was measured


class ComparedRun(ViewModel):
    """A run of a comparison; where it cannot be read, `error` says why, and all that follows is missing."""

    id: Text  # in the dashboard its id, otherwise its folder
    name: Text
    color: str  # of its curves
    error: Text | None = None
    path: Text = ""
    status: str = "unreadable"
    label: str = "unreadable"
    stage: str = ""  # as people read it
    progress: float = 0.0
    scene: Text | None = None
    fingerprint: Text | None = None
    version: Text | None = None  # of PanoLOG
    recipe: Text | None = None
    width: int | None = None  # training width in pixels
    stage_one: Trained | None = None
    blocks: int | None = None
    blocks_done: int | None = None
    stage_two: Trained | None = None  # all that trains after Stage I
    gaussians: int | None = None  # of the merged model, before it of what the merge would keep now
    bytes: int | None = None  # of the merged model
    seconds: float | None = None  # in which a driver was at work
    stages: tuple[StageTime, ...] = ()
    memory: int | None = None  # bytes: the peak of the host memory of a task
    gpu_memory: int | None = None  # bytes: the peak of a task on its GPU
    machines: tuple[Text, ...] = ()
    measured: MeasuredView | None = None
    metrics: dict[str, MetricView] = Field(default_factory=dict)


class DifferentSetting(ViewModel):
    """A setting that is not the same in all runs; `known` is false where a run's version does not have it."""

    key: Text
    values: tuple[Any, ...]  # one for each run
    known: tuple[bool, ...]
    doc: str


class ComparedView(ViewModel):
    """A held-out panorama: its metrics and its picture in each run.

    A picture has the render at its top and the ground truth at its bottom, or is the one of them that it
    stands for; `truth` is a picture with the ground truth.
    """

    name: Text
    metrics: tuple[dict[str, float | None] | None, ...]
    pictures: tuple[Text | None, ...]
    truth: Text | None


class Comparison(ViewModel):
    """Runs side by side. `first` is the index of the run that the others are compared with."""

    first: int
    runs: tuple[ComparedRun, ...]
    warnings: tuple[Text, ...]  # why the comparison is not fair, one line each
    settings: tuple[DifferentSetting, ...]
    more_settings: int  # that differ, besides these
    views: tuple[ComparedView, ...]
    more_views: int


class Line(ViewModel):
    """The points of a curve."""

    x: tuple[float, ...]
    y: tuple[float | None, ...]


class Curve(ViewModel):
    """A value over the iterations of a run, its stages one after the other, and over its minutes."""

    iterations: Line
    minutes: Line


class StageCurves(ViewModel):
    """The curves of a stage: the mean of its tasks, of Gaussians the sum. `read` of `tasks` are in it."""

    stage: str
    label: str
    tasks: int
    read: int
    curves: dict[str, Curve]  # "loss", "psnr", "gaussians"


class RunCurves(ViewModel):
    """The curves of a run, by its stages; `error` says why there are none."""

    id: Text
    stages: tuple[StageCurves, ...]
    error: Text | None = None


class CurvesOfRuns(ViewModel):
    """The curves of the runs of a comparison, in their order."""

    runs: tuple[RunCurves, ...]
