"""A report of several runs: the page that compares them with a snapshot, as one self-contained file."""

from collections.abc import Sequence
from pathlib import Path

from panolog.orchestrator.runs.folder import opened
from panolog.orchestrator.watch.views.comparison.compare import compare
from panolog.orchestrator.watch.views.comparison.curves import curves_of
from panolog.orchestrator.watch.views.comparison.reading import ReadRun, picture_of, read_runs
from panolog.orchestrator.watch.views.pages.shell import COMPARISON, data_url, write_snapshot
from panolog.orchestrator.watch.views.queries import spread
from panolog.orchestrator.watch.views.site.photographs import Part, small_copy
from panolog.scene.errors import InputError
from panolog.scene.files import natural_key

_PICTURES = 60  # of all runs and the ground truth
_PANORAMAS = 12  # that are shown at most
_WIDTH = 1024  # pixels of a picture


def write_comparison(roots: Sequence[Path], output: Path) -> None:
    """Writes the comparison of runs in their present state, atomically.

    Raises InputError as `read_runs`, or if a run's files are damaged; OSError if the page cannot be written.
    """
    runs = read_runs(roots)
    pictures = _Pictures(runs)
    answers = {"compare?": compare(runs, pictures.render, pictures.truth), "compare/curves?": curves_of(runs)}
    write_snapshot(output, COMPARISON, answers, {"runs": {"runs": []}})


class _Pictures:
    """Small pictures of some held-out panoramas, as data URLs."""

    def __init__(self, runs: Sequence[ReadRun]) -> None:
        self._runs = runs
        self._names = set(_chosen(runs))

    def render(self, run: ReadRun, view: str) -> str | None:
        """The render of a run, if the panorama is one of those that are shown."""
        return self._part(run, view, "render") if view in self._names else None

    def truth(self, view: str) -> str | None:
        """The ground truth, of the first run that has it."""
        if view not in self._names:
            return None
        found = (self._part(run, view, "truth") for run in self._runs)
        return next((url for url in found if url is not None), None)

    def _part(self, run: ReadRun, view: str, part: Part) -> str | None:
        try:
            with opened(run.folder.picture(view), run.folder.images) as file:
                return data_url("image/jpeg", small_copy(file, view, _WIDTH, part))
        except InputError:
            return None


def _chosen(runs: Sequence[ReadRun]) -> list[str]:
    """Panoramas that all runs have a picture of, or else some run: from the first run's worst to its best."""
    names = sorted({name for run in runs if run.measured for name in run.measured.views}, key=natural_key)
    have = {name: sum(picture_of(run, name) is not None for run in runs) for name in names}
    everywhere = [name for name in names if have[name] == len(runs)]
    found = everywhere or [name for name in names if have[name]]
    views = runs[0].measured.views if runs[0].measured else {}
    ranked = sorted(found, key=lambda name: views.get(name, {}).get("psnr") or 0.0)
    return spread(ranked, min(_PANORAMAS, _PICTURES // (len(runs) + 1)))
