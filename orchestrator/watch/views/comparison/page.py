"""A report of several runs: the page that compares them with a snapshot, as one self-contained file."""

from collections.abc import Sequence
from io import BytesIO
from pathlib import Path

from PIL import Image

from panolog.orchestrator.watch.views.comparison.compare import compare
from panolog.orchestrator.watch.views.comparison.curves import curves_of
from panolog.orchestrator.watch.views.comparison.reading import ReadRun, picture_of, read_runs
from panolog.orchestrator.watch.views.pages.shell import COMPARISON, data_url, write_snapshot
from panolog.orchestrator.watch.views.queries import spread
from panolog.scene.files import natural_key

_PICTURES = 60  # of all runs and the ground truth
_PANORAMAS = 12  # that are shown at most
_WIDTH, _QUALITY = 1024, 82  # pixels and JPEG quality of a picture
_FILE, _PIXELS = 50_000_000, 2**28  # bytes and pixels of a run's picture at most
# What a damaged image makes Pillow raise.
_DAMAGED = (OSError, SyntaxError, ValueError, EOFError, Image.DecompressionBombError)


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
        return self._part(run, view, truth=False) if view in self._names else None

    def truth(self, view: str) -> str | None:
        """The ground truth, of the first run that has it."""
        if view not in self._names:
            return None
        found = (self._part(run, view, truth=True) for run in self._runs)
        return next((url for url in found if url is not None), None)

    def _part(self, run: ReadRun, view: str, *, truth: bool) -> str | None:
        path = picture_of(run, view)
        jpeg = _cut(Path(path), truth=truth) if path is not None else None
        return None if jpeg is None else data_url("image/jpeg", jpeg)


def _chosen(runs: Sequence[ReadRun]) -> list[str]:
    """Panoramas that all runs have a picture of, or else some run: from the first run's worst to its best."""
    names = sorted({name for run in runs if run.measured for name in run.measured.views}, key=natural_key)
    have = {name: sum(picture_of(run, name) is not None for run in runs) for name in names}
    everywhere = [name for name in names if have[name] == len(runs)]
    found = everywhere or [name for name in names if have[name]]
    views = runs[0].measured.views if runs[0].measured else {}
    ranked = sorted(found, key=lambda name: views.get(name, {}).get("psnr") or 0.0)
    return spread(ranked, min(_PANORAMAS, _PICTURES // (len(runs) + 1)))


def _cut(path: Path, *, truth: bool) -> bytes | None:
    """The ground truth at the bottom of a picture or the render at its top; None if it is no such picture."""
    try:
        if path.stat().st_size > _FILE:
            return None
        with Image.open(path, formats=("JPEG",)) as picture:  # reads the header alone
            width, height = picture.size
            if width * height > _PIXELS or height < width:
                return None
            picture.draft("RGB", (_WIDTH, _WIDTH))
            half = picture.size[0] // 2
            top = picture.size[1] - half if truth else 0
            part = picture.convert("RGB").crop((0, top, picture.size[0], top + half))
    except _DAMAGED:
        return None
    if part.width > _WIDTH:
        part = part.resize((_WIDTH, _WIDTH // 2), Image.Resampling.LANCZOS)
    output = BytesIO()
    part.save(output, "JPEG", quality=_QUALITY)
    return output.getvalue()
