"""The runs of a comparison as they are read from their folders. Imports no torch."""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from panolog.orchestrator.runs import lock, presence
from panolog.orchestrator.runs.folder import RunFolder, head_of, is_below, read_json, require_plain
from panolog.orchestrator.runs.info import read_history
from panolog.orchestrator.runs.state import RunState
from panolog.orchestrator.watch.views.comparison.measured import Measured, read_measured
from panolog.orchestrator.watch.views.comparison.schema import MOST
from panolog.orchestrator.watch.views.history import History
from panolog.orchestrator.watch.views.preparation import view_preparation
from panolog.orchestrator.watch.views.run_view import RunView, view_run
from panolog.scene.errors import InputError, RunFolderError

# What values of another type than expected make a view of a run raise.
DAMAGED = (ValueError, TypeError, KeyError, AttributeError, ArithmeticError, RecursionError)


@dataclass(frozen=True)
class ReadRun:
    """A run as a comparison needs it."""

    id: str
    name: str
    folder: RunFolder
    view: RunView
    state: RunState
    measured: Measured | None
    problem: str = ""  # why metrics.json cannot be read


@dataclass(frozen=True)
class UnreadRun:
    """A run that cannot be read, and why."""

    id: str
    name: str
    error: str


def read_runs(roots: Sequence[Path]) -> tuple[ReadRun, ...]:
    """The runs in some folders, each by its own name.

    Raises InputError if there are fewer than two or more than MOST, one of them twice, or if one is no run or
    cannot be read.
    """
    if len(roots) < 2:
        raise InputError("a comparison needs two runs or more")
    if len(roots) > MOST:
        raise InputError(f"a comparison has at most {MOST} runs, and {len(roots)} are given")
    places = [root.resolve() for root in roots]
    for place, root in zip(places, roots, strict=True):
        if places.count(place) > 1:
            raise InputError(f"{root}: is given twice; a comparison needs different runs")
    names = names_of(places)
    return tuple(read_run(root, name) for root, name in zip(roots, names, strict=True))


def names_of(places: Sequence[Path]) -> list[str]:
    """The last parts of some different absolute paths, as many as it takes to tell them apart."""
    for parts in range(1, max(len(place.parts) for place in places)):
        names = ["/".join(place.parts[1:][-parts:]) or "/" for place in places]
        if len(set(names)) == len(names):
            return names
    return [str(place) for place in places]


def read_run(root: Path, name: str) -> ReadRun:
    """A run, live or ended. Raises InputError if the folder is no run or its files are damaged."""
    folder = RunFolder(root)
    require_plain(folder)
    try:
        info = read_json(folder)
        head_of(folder, info)
        running = lock.held(folder.lock)  # before the records, so that all that an ended driver wrote is read
        history = History.of(read_history(folder))
        waiting = presence.waiting(folder.presence) if running else ""
        made = view_preparation(folder, history.state, running=running)
        view = view_run(history, info, running=running, root=root, waiting=waiting, preparation=made)
        measured = read_measured(folder)
    except DAMAGED as error:
        why = f"{type(error).__name__}: {error}"
        raise RunFolderError(f"{root}: cannot be read as a run of this PanoLOG: {why:.200}") from error
    return ReadRun(str(root), name, folder, view, history.state, measured)


def picture_of(run: ReadRun, view: str) -> str | None:
    """The file with the render of a held-out panorama above its ground truth; None if there is none."""
    with suppress(ValueError):  # a name that no file can have
        path = run.folder.picture(view)
        return str(path) if is_below(path, run.folder.images) else None
    return None
