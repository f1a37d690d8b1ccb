"""Places whose facades repeat, as photographs, with shuffled names and as videos: right, refused or wrong.

    python -m benchmarks.places.repetition FOLDER [--places square grid …] [--kinds photographs …]

FOLDER keeps the panoramas, so a second call renders nothing. A result is right if the positions of all
panoramas with a pose differ from the true ones by at most 0.2 % of the way, root mean square after the best
similarity. Wrong is what is neither right nor refused.
"""

import argparse
import json
import shutil
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from benchmarks import report
from benchmarks.places.layouts import LAYOUTS
from benchmarks.places.shoot import Walk, as_video, shoot
from panolog.prepare.sfm.pipeline import SfmSettings, make_scene
from panolog.scene.errors import InputError
from panolog.scene.read import read_scene
from panolog.scene.write import no_progress
from tests.prepare.sfm.accuracy import drift, length

KINDS = ("photographs", "shuffled", "video")
_RIGHT = 0.2  # percent of the way
HEAD = ("place", "as", "outcome", "registered", "rms, % of the way", "seconds")


@dataclass(frozen=True)
class Outcome:
    """What became of a place."""

    place: str
    kind: str
    outcome: str  # right, refused or wrong
    registered: str
    drift: float | None  # percent
    seconds: float
    message: str = ""  # of the refusal


def try_place(name: str, kind: str, walk: Walk, folder: Path) -> Outcome:
    """One way of giving a place to `panolog scene sfm`."""
    scene = folder / "scene"
    for leftover in (scene, folder / "scene.sfm", folder / "source"):
        shutil.rmtree(leftover, ignore_errors=True)
    count = len(walk.images)
    names = {f"{row:03d}": row for row in range(count)}
    source = folder / "source"
    source.mkdir(parents=True)
    if kind == "video":
        source = as_video(walk, source / "walk.mp4")
        names = {f"walk_{row:06d}": row for row in range(count)}
    else:
        order = np.random.default_rng(7).permutation(count) if kind == "shuffled" else np.arange(count)
        names = {f"{place:03d}": int(row) for place, row in enumerate(order)}
        for stem, row in names.items():
            (source / f"{stem}.jpg").symlink_to(walk.images[row].resolve())
    begin = time.perf_counter()
    try:
        make_scene(source, scene, SfmSettings(), no_progress)
    except InputError as error:
        seconds = time.perf_counter() - begin
        return Outcome(name, kind, "refused", f"0 of {count}", None, seconds, str(error))
    seconds = time.perf_counter() - begin
    made = read_scene(scene)
    rows = [names[panorama.stem] for panorama in made.panoramas]
    off = 100 * drift(made.centers, walk.centers[rows]) / length(walk.centers)
    outcome = "right" if off <= _RIGHT else "wrong"
    return Outcome(name, kind, outcome, f"{len(rows)} of {count}", off, seconds)


def main(arguments: Sequence[str] | None = None) -> int:
    """The program; returns its exit code."""
    parser = report.parser("repetition", __doc__, quick=False)
    parser.add_argument("folder", type=Path, metavar="FOLDER", help="for the panoramas and scenes")
    parser.add_argument("--places", nargs="*", choices=LAYOUTS, default=list(LAYOUTS))
    parser.add_argument("--kinds", nargs="*", choices=KINDS, default=list(KINDS))
    parser.add_argument("--bare", action="store_true", help="no texture on ground and sky")
    parser.add_argument("--width", type=int, default=1024)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args(arguments)

    def work() -> report.Report:
        found = [outcome for place in options.places for outcome in _place(place, options)]
        table = report.markdown(HEAD, [tuple(asdict(it).values())[: len(HEAD)] for it in found])
        passed = all(it.outcome != "wrong" for it in found)
        return report.Report({"results": [asdict(it) for it in found]}, table, passed)

    return report.run("repetition", options, work)


def _place(name: str, options: argparse.Namespace) -> list[Outcome]:
    folder = options.folder / f"{name}{'-bare' if options.bare else ''}-{options.width}-{options.seed}"
    walk = shoot(name, folder, bare=options.bare, width=options.width, seed=options.seed)
    found = []
    for kind in options.kinds:
        found.append(try_place(name, kind, walk, folder / kind))
        print(json.dumps(asdict(found[-1])), file=sys.stderr, flush=True)
    return found


if __name__ == "__main__":
    sys.exit(main())
