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
from benchmarks.paper.variants import flat, variants
from panolog.orchestrator.runs.config import RunConfig
from panolog.orchestrator.runs.folder import write_json
from panolog.scene.errors import InputError
from panolog.scene.files import write_bytes
from panolog.workers.training.recipes import Recipe

RECIPES_FILE = "recipes.json"
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


def write(folder: Path, study: Study) -> str:
    """Writes report.md, results.csv and the pictures; returns the Markdown."""
    drawn = pictures(study)
    for name, svg in drawn.items():
        write_bytes(folder / name, standalone(svg).encode())
    text = markdown([study], {name: name for name in drawn})
    write_bytes(folder / "report.md", text.encode())
    sheet = io.StringIO()
    csv.writer(sheet, lineterminator="\n").writerows(csv_rows(study.results.all))
    write_bytes(folder / "results.csv", sheet.getvalue().encode())
    return text


def markdown(studies: Sequence[Study], links: dict[str, str]) -> str:
    """All studies as one document. Args: links, paths of pictures by name, as the document sees them."""
    parts = ["# Quality"]
    for number, study in enumerate(studies):
        parts += [f"## {study.title}", f"    {study.command}", study.place]
        if found := study.goals:
            parts.append(goal_table(found).markdown())
        prefix = f"{number}-" if len(studies) > 1 else ""
        drawn = [name for name in pictures(study) if prefix + name in links]
        parts += [f"![{name.removesuffix('.svg')}]({links[prefix + name]})" for name in drawn]
        parts += [table.markdown() for table in study.tables]
    return "\n\n".join([*parts, "## How it was measured", _METHOD, _CURVES]) + "\n"


def write_docs(path: Path, study: Study) -> None:
    """Adds a study to a page of the documentation.

    A folder next to the page has its pictures, the results of all studies that it shows, each in a folder of
    its own, and the settings of the recipes in them, recipes.json. Raises InputError if a result is of other
    settings than its variant has now.
    """
    folder = path.with_suffix("")
    kept = {it.name: it for it in map(load, sorted(file.parent for file in folder.glob("*/results.json")))}
    kept[study.name] = kept[study.name].joined(study) if study.name in kept else study
    studies = sorted(kept.values(), key=lambda it: (it.settings.width, it.settings.iterations, it.chosen))
    recipes = measured_recipes(studies)
    (folder / study.name).mkdir(parents=True, exist_ok=True)
    kept[study.name].save(folder / study.name)
    write_json(folder / RECIPES_FILE, {name: flat(RunConfig(recipe=name)) for name in recipes})
    links = {}
    for number, each in enumerate(studies):
        for name, svg in pictures(each).items():
            own = f"{number}-{name}" if len(studies) > 1 else name
            write_bytes(folder / own, standalone(svg).encode())
            links[own] = f"{folder.name}/{own}"
    write_bytes(path, (FIRST_LINE + "\n\n" + markdown(studies, links)).encode())


def measured_recipes(studies: Sequence[Study]) -> list[Recipe]:
    """The recipes of all results, in the order of the tables. Raises InputError as `write_docs`."""
    found: dict[Recipe, None] = {}
    for study in studies:
        for result in study.results.all:
            if result.failed:
                continue
            now = variants()[result.variant].config(study.settings, result.seed, result.iterations)
            if changes := other_settings(result.settings, now):
                where = f"{result.variant} of {result.scene} in {study.name}"
                raise InputError(f"{where} has {changes}: measure it again, or remove its results")
            found[now["recipe"]] = None
    return list(found)
