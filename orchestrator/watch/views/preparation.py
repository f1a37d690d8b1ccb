"""How far a run is that makes its scene, and what its steps have made: for status, dashboard and report."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Literal

from panolog.orchestrator.runs.folder import RunFolder
from panolog.orchestrator.runs.info import read_info
from panolog.orchestrator.runs.preparation import forecast, notes
from panolog.orchestrator.runs.preparation.notes import Counts, StepProgress, StepResult
from panolog.orchestrator.runs.preparation.settings import Settings, Step, read_settings
from panolog.orchestrator.runs.state import RunState
from panolog.orchestrator.watch.views.summary import Text, ViewModel
from panolog.scene.errors import InputError

STEPS = {Step.MASKS: "masks", Step.SFM: "poses and points", Step.DEPTH: "depth", Step.CHECK: "check"}
_LINES = 12  # of a step that are shown
_PICTURES = {"sfm": "Poses from above", "masks": "Masks, in red"}


class StepView(ViewModel):
    """A step; `done` of `total` of `what` while it runs, a `total` of 0 is not known."""

    name: str
    label: str
    status: Literal["waiting", "running", "stopped", "done"]
    what: Text
    done: int
    total: int
    seconds: float | None
    lines: tuple[Text, ...]


class PictureView(ViewModel):
    """A picture of what a step has made; `version` changes with it."""

    name: str
    label: str
    version: str


class PreparationView(ViewModel):
    """The preparation of a run; the counts are None before there are poses."""

    source: Text
    others: tuple[Text, ...] = ()  # besides it
    video: bool  # or one of them at least
    frames: int  # in the videos by their headers, and panoramas in the folders
    panoramas: int | None  # chosen
    registered: int | None  # that have a pose
    points: int | None
    weak_links: int | None
    contradictions: int | None
    latest: float | None  # when it last made progress, in seconds since the epoch
    progress: float  # how much of its time is over, 0 to 1
    over: float  # the same of the whole run, with a training of which nothing is measured yet
    steps: tuple[StepView, ...]
    pictures: tuple[PictureView, ...]


def picture_paths(folder: RunFolder) -> dict[str, Path]:
    """Where the pictures of `_PICTURES` are, by name."""
    return {"sfm": folder.sfm_picture, "masks": folder.masks_picture}


def stamp_of(folder: RunFolder) -> tuple[object, ...]:
    """A value that changes whenever the view may; empty for a run that was given a scene."""
    if not folder.preparation.is_dir():
        return ()
    files = [folder.preparation_settings, folder.preparation_progress]
    files += [folder.step_result(step) for step in Step]
    return tuple(_state(path) for path in (*files, *picture_paths(folder).values()))


def view_preparation(folder: RunFolder, state: RunState, *, running: bool) -> PreparationView | None:
    """The view of a run's preparation; None of a run that was given a scene, or if that cannot be read.

    Args: running, whether a driver works on the run.
    """
    try:
        settings = read_settings(folder)
    except InputError:
        return None
    if settings is None:
        return None
    progress = notes.read_progress(folder)
    results = {step: notes.read_result(folder, step) for step in settings.steps()}
    active = running and state.preparing and not state.prepared
    made = results.get(Step.SFM)
    counts = made.counts if made else None
    steps = [_step(step, result, progress, active) for step, result in results.items()]
    chosen = counts.panoramas if counts else progress.panoramas if progress else 0
    done, whole = _progress(settings, steps, chosen or None)
    return PreparationView(
        source=settings.source,
        others=settings.others,
        video=settings.video,
        frames=settings.panoramas,
        **{name: getattr(counts, name, None) for name in Counts.model_fields},
        latest=progress.time or None if progress else None,
        progress=done / whole,
        over=done / (whole + _training(folder, settings.width)),
        steps=tuple(steps),
        pictures=tuple(_pictures(folder)),
    )


def _progress(settings: Settings, steps: Sequence[StepView], chosen: int | None) -> tuple[float, float]:
    """Seconds that are over as forecast, and those of all."""
    parts = forecast.parts_of(settings, chosen)
    began_masks = any(step.name == Step.MASKS and step.status != "waiting" for step in steps)
    done = 0.0
    for step in steps:
        own = {part: took for (of, part), took in parts.items() if of == step.name}
        names = list(own)
        at = names.index(step.what) if step.what in names else 0
        if step.status == "done":
            at = len(names)
        elif step.name == Step.SFM and began_masks:
            at = max(at, len(forecast.BEFORE_MASKS))
        done += sum(own[name] for name in names[:at])
        if at < len(names) and step.what == names[at] and step.total:
            within = forecast.REPEATED.get(step.what, min(1.0, step.done / step.total))
            done += own[step.what] * within
    return done, sum(parts.values())


def with_step(state: RunState, view: PreparationView | None) -> RunState:
    """The state of a live run with how far its preparation is, which the database does not have."""
    active = [step for step in view.steps if step.status == "running"] if view else []
    if not active:
        return state
    step = active[0]
    return replace(
        state, step=str(StepProgress(step=Step(step.name), what=step.what, done=step.done, total=step.total))
    )


def _training(folder: RunFolder, width: int) -> float:
    """Seconds of what follows the preparation, as forecast; none if run.json cannot be read."""
    try:
        return forecast.training(read_info(folder).config, width)
    except InputError:
        return 0.0


def _step(step: Step, result: StepResult | None, progress: StepProgress | None, active: bool) -> StepView:
    """Args: active, whether a driver is at work on one of the steps."""
    now = progress if result is None and progress is not None and progress.step is step else None
    return StepView(
        name=step,
        label=STEPS[step],
        status="done" if result else "waiting" if now is None else "running" if active else "stopped",
        what=now.what if now else "",
        done=now.done if now else 0,
        total=now.total if now else 0,
        seconds=result.seconds if result else None,
        lines=_first(result.lines) if result else (),
    )


def _first(lines: Sequence[str]) -> tuple[str, ...]:
    more = len(lines) - _LINES
    return (*lines[:_LINES], *([f"… and {more:,} more"] if more > 0 else []))


def _pictures(folder: RunFolder) -> list[PictureView]:
    versions = {name: version_of(path) for name, path in picture_paths(folder).items()}
    there = [(name, version) for name, version in versions.items() if version is not None]
    return [PictureView(name=name, label=_PICTURES[name], version=version) for name, version in there]


def version_of(path: Path) -> str | None:
    """A text that changes with a file; None if there is none."""
    state = _state(path)
    return None if state is None else f"{state[0]:x}-{state[1]:x}"


def _state(path: Path) -> tuple[int, int] | None:
    """When a file was written, and its size; None if there is none."""
    try:
        status = path.lstat()
    except OSError:
        return None
    return status.st_mtime_ns, status.st_size
