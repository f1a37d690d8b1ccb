"""The paper's tables and the recipes' worth on some scenes, in one resumable command.

    python -m benchmarks.paper SCENE ... -o FOLDER [--width 512] [--iterations 600] [--seeds 3]
    python -m benchmarks.paper SCENE ... -o FOLDER --docs docs/quality.md

FOLDER keeps every run and its result; what is there is not run again. So does the page: a folder next to it
keeps all results that it shows, and the command adds its own.
"""

import argparse
import json
import sys
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

from scipy.sparse import csr_array

from benchmarks import report
from benchmarks.paper import pages, tables
from benchmarks.paper.goals import KINDS
from benchmarks.paper.results import Result, Results
from benchmarks.paper.runner import Bench, run_all
from benchmarks.paper.study import Study
from benchmarks.paper.variants import Settings, groups, stages, variants
from panolog.orchestrator.runs.config import load_config
from panolog.orchestrator.runs.folder import RunFolder, write_json
from panolog.orchestrator.runs.machines.machine import cores
from panolog.partition.plan import Plan, read_plan
from panolog.partition.scores import read_scores
from panolog.renderer.process import prepare
from panolog.scene.errors import InputError
from panolog.scene.read import read_scene
from panolog.workers.training.recipes import RECIPES

_PLANS = ("paper", "authors", "panolog")  # whose overlap is shown


def parse(arguments: Sequence[str] | None = None) -> argparse.Namespace:
    """The command line."""
    names = [group.name for group in groups()]
    parser = report.parser("paper", __doc__, quick=False)
    parser.add_argument("scenes", type=Path, nargs="+", metavar="SCENE")
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="FOLDER")
    parser.add_argument("--tables", default=",".join(names), help=f"of {', '.join(names)}; default: all")
    parser.add_argument("--width", type=int, default=512, help="of the panoramas, in pixels")
    parser.add_argument("--iterations", type=int, default=600, help="of Stage I and of each block")
    parser.add_argument("--blocks", default="2x1x1")
    parser.add_argument("--seeds", type=int, default=1, help="of what is given with a spread")
    parser.add_argument("--device", default="auto", choices=("auto", "cpu", "cuda"))
    parser.add_argument("--set", dest="sets", action="append", default=[], metavar="KEY=VALUE")
    parser.add_argument(
        "--kind",
        dest="kinds",
        action="append",
        default=[],
        metavar="SCENE=KIND",
        help=f"what a scene's goals are: of {', '.join(KINDS)}; default: street",
    )
    running = parser.add_mutually_exclusive_group()
    running.add_argument(
        "--only", metavar="VARIANTS", help="run only these, comma-separated; report what has a result"
    )
    running.add_argument("--finished", action="store_true", help="run nothing: report what has a result")
    parser.add_argument(
        "--docs", type=Path, metavar="FILE", help="add the results to this page of the documentation"
    )
    parsed = parser.parse_args(arguments)
    given = parsed.tables.split(",")
    if unknown := set(given) - set(names):
        parser.error(f"--tables: {', '.join(sorted(unknown))} is none of {', '.join(names)}")
    if parsed.seeds < 1:
        parser.error("--seeds: at least 1")
    found = {variant.name for table in stages(given) for variant in table}
    parsed.only = () if parsed.finished else parsed.only and tuple(parsed.only.split(","))
    if unknown := set(parsed.only or ()) - found:
        parser.error(f"--only: {', '.join(sorted(unknown))} is none of {', '.join(sorted(found))}")
    kinds = {scene: kind for scene, _, kind in (pair.partition("=") for pair in parsed.kinds)}
    for scene, kind in kinds.items():
        if scene not in {path.resolve().name for path in parsed.scenes} or kind not in KINDS:
            parser.error(f"--kind {scene}={kind}: give the name of a scene and one of {', '.join(KINDS)}")
    parsed.kinds = kinds
    parsed.tables = [name for name in names if name in given]
    return parsed


def checked(options: argparse.Namespace) -> Settings:
    """The settings, once all input is found to be right. Raises InputError for the first that is not."""
    names = [scene.resolve().name for scene in options.scenes]
    if twice := {name for name in names if names.count(name) > 1}:
        raise InputError(f"two scenes are named {min(twice)}: rename one, results go by name")
    for scene in options.scenes:
        if not read_scene(scene).test:
            raise InputError(f"{scene}: has no held-out panoramas, so nothing can be measured")
    settings = Settings(
        options.width, options.iterations, options.blocks, options.device, tuple(options.sets)
    )
    known = variants()
    for recipe in RECIPES:  # a switch alone may be refused: then its row says why
        load_config(None, known[recipe].sets(settings, 0, settings.iterations))
    store_settings(options.output, settings)
    return settings


def store_settings(folder: Path, settings: Settings) -> None:
    """Stores the settings in the folder. Raises InputError if it holds results at others."""
    path, given = folder / "settings.json", json.loads(json.dumps(asdict(settings)))
    stored = json.loads(path.read_bytes()) if path.exists() else given
    for key, value in given.items():
        if stored.get(key) != value:
            raise InputError(
                f"{folder}: has results with {key} {stored.get(key)}, not {value}; take another folder"
            )
    folder.mkdir(parents=True, exist_ok=True)
    write_json(path, given)


def measure(options: argparse.Namespace, settings: Settings) -> Study:
    """Runs what is missing. The study so far is written after each result."""
    scenes = [scene.resolve() for scene in options.scenes]
    tables_of_variants = stages(options.tables)
    chosen = [variant for stage in tables_of_variants for variant in stage]
    benches = [
        Bench(options.output, scene, seed, settings) for scene in scenes for seed in range(options.seeds)
    ]
    for bench in benches:
        bench.check(chosen)
    done: list[Result] = []

    def so_far() -> Study:
        overlaps = [row for bench in benches if bench.seed == 0 for row in _overlaps(bench)]
        return Study(
            settings,
            tuple(options.tables),
            tuple("/".join(scene.parts[-2:]) for scene in scenes),
            Results(tuple(done)),
            tuple(overlaps),
            options.kinds,
        )

    for result in run_all(benches, tables_of_variants, options.only):
        done.append(result)
        so_far().save(options.output)
    made = so_far()
    made.save(options.output)
    pages.write(options.output, made)
    return made


def _overlaps(bench: Bench) -> list[tables.Overlap]:
    """Of the recipes whose scores differ."""
    plans: dict[str, tuple[Plan, csr_array]] = {}
    for name in _PLANS:
        if name in bench.done and (folder := RunFolder(bench.done[name].root)).plan.exists():
            plan = read_plan(folder.plan)
            scores = read_scores(folder.scores, plan.rows, plan.grid.count)
            if all(scores.shape != other.shape or (scores != other).nnz for _, other in plans.values()):
                plans[name] = (plan, scores)
    return [row for name, found in plans.items() for row in tables.overlaps(bench.scene.name, name, *found)]


def main(arguments: Sequence[str] | None = None) -> int:
    """The program; returns its exit code."""
    options = parse(arguments)

    def work() -> report.Report:
        settings = checked(options)
        prepare(cores())
        made = measure(options, settings)
        if options.docs:
            pages.write_docs(options.docs, made)
        failed = any(result.failed for result in made.results.all)
        return report.Report(made.to_json(), pages.markdown([made]), passed=not failed)

    try:
        return report.run("paper", options, work)
    except KeyboardInterrupt:
        print("paper: interrupted; the same command continues", file=sys.stderr)
        return 130


if __name__ == "__main__":
    sys.exit(main())
