"""The report of a study: Markdown, CSV, pictures, and the page of the documentation."""

import csv
import io
from collections.abc import Sequence
from pathlib import Path

from benchmarks.paper.curves import overlap_curve, quality_curve, standalone
from benchmarks.paper.goals import table as goal_table
from benchmarks.paper.runner import other_settings
from benchmarks.paper.study import Study, load
from benchmarks.paper.tables import csv_rows
from benchmarks.paper.variants import variants
from panolog.scene.errors import InputError
from panolog.scene.files import write_bytes

FIRST_LINE = "<!-- Written by `python -m benchmarks.paper … --docs`: do not edit. -->"
_METHOD = (
    "**Runs.** Where those of a section are not of one machine and one version of the code, each row says of"
    " which, and only metrics compare. Metrics are means over the held-out panoramas, which no run trains on."
    " Minutes are wall clock from the start of the first task to the merged model, with the checkpoints,"
    " without the start of program and Ray and without evaluation. Tasks run one at a time, each with all"
    " cores of the command, so that seconds of Stage I and of a block compare; several commands may fill a"
    " section (`--only`) at the same time, each on cores of its own. `on workers` has the longest block in"
    " place of Stage II: a simulation of as many such machines as blocks. Runs with the same Stage I share"
    " it, and count its seconds. A gain is in WS-PSNR against the first row; what follows ± is the standard"
    " deviation over seeds. `densified` and `resets` say how often Gaussians were densified and opacities"
    " reset: their schedules scale with the length of a run, down to least intervals."
)
_CURVES = (
    "**WS-PSNR 2×** is at twice the width of training, where panoramas have that: as seen from nearer.\n\n"
    "**Curves.** All points of a line are states of one run on its way: its own checkpoints, evaluated after"
    " its end as the merged model that they would give. Diamonds are ends of Stage I. After a reset of"
    " opacities a state is worse than the model that it becomes. The first point is the first checkpoint."
)


def pictures(study: Study) -> dict[str, str]:
    """SVG by the name of its file."""
    found = {f"quality-{Path(scene).name}.svg": Path(scene).name for scene in study.scenes}
    made = {file: svg for file, scene in found.items() if (svg := quality_curve(study.results, scene))}
    overlap = overlap_curve(study.overlaps)
    return made | ({"overlap.svg": overlap} if overlap else {})


def write(folder: Path, study: Study) -> None:
    """Writes report.md, results.csv and the pictures."""
    _draw(folder, study)
    write_bytes(folder / "report.md", markdown([study]).encode())
    sheet = io.StringIO()
    csv.writer(sheet, lineterminator="\n").writerows(csv_rows(study.results.all))
    write_bytes(folder / "results.csv", sheet.getvalue().encode())


def _draw(folder: Path, study: Study) -> None:
    for name, svg in pictures(study).items():
        write_bytes(folder / name, standalone(svg).encode())


def markdown(studies: Sequence[Study], folder: str = "") -> str:
    """All studies as one document. Args: folder that has a folder of each study with its pictures."""
    parts = ["# Quality"]
    for study in studies:
        parts += [f"## {study.title}", f"    {study.command}", study.place]
        if found := study.goals:
            parts.append(goal_table(found).markdown())
        where = f"{folder}/{study.name}/" if folder else ""
        parts += [f"![{name.removesuffix('.svg')}]({where}{name})" for name in pictures(study)]
        parts += [table.markdown() for table in study.tables]
    return "\n\n".join([*parts, "## How it was measured", _METHOD, _CURVES]) + "\n"


def write_docs(path: Path, study: Study) -> None:
    """Adds a study to a page of the documentation.

    Next to the page, a folder for each study that it shows has its results and pictures. Raises InputError if
    a result is of other settings than its variant has now.
    """
    kept = {it.name: it for it in studies_of(path)}
    kept[study.name] = kept[study.name].joined(study) if study.name in kept else study
    studies = sorted(kept.values(), key=lambda it: (it.settings.width, it.settings.iterations, it.chosen))
    check_settings(studies)
    folder = path.with_suffix("") / study.name
    folder.mkdir(parents=True, exist_ok=True)
    kept[study.name].save(folder)
    _draw(folder, kept[study.name])
    text = markdown(studies, path.stem)
    write_bytes(path, (FIRST_LINE + "\n\n" + text).encode())


def studies_of(path: Path) -> list[Study]:
    """The studies that a page of the documentation shows."""
    return [load(file.parent) for file in sorted(path.with_suffix("").glob("*/results.json"))]


def check_settings(studies: Sequence[Study]) -> None:
    """Raises InputError if a result is of other settings than its variant has now."""
    for study in studies:
        settings = {Path(scene).name: study.settings.of(Path(scene)) for scene in study.scenes}
        for result in study.results.all:
            if result.failed:
                continue
            variant, own = variants()[result.variant], settings[result.scene]
            now = variant.config(own, result.seed, result.iterations)
            if changes := other_settings(result.settings, now):
                where = f"{result.variant} of {result.scene} in {study.name}"
                raise InputError(f"{where} has {changes}: measure it again, or remove its results")
