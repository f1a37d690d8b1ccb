"""Captures of places with known poses: are the poses of `panolog scene sfm` right and whole?

    python -m benchmarks.places.captures FOLDER [--places square grid …] [--scene SCENE] [--kinds video …]

The places are those of `layouts`, whose houses are copies of one, or a SCENE with known poses. FOLDER keeps
the panoramas, so a second call renders nothing. Poses are right if the positions of all panoramas that have
one differ from the true ones by at most 0.2 % of the way, root mean square after the best similarity.
"""

import argparse
import json
import resource
import shutil
import sys
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from benchmarks import report
from benchmarks.places.layouts import LAYOUTS
from benchmarks.places.shoot import Walk, as_video, shoot
from panolog.prepare.sfm.pipeline import SfmSettings, make_scene
from panolog.scene.errors import InputError
from panolog.scene.files import write_bytes
from panolog.scene.image_files import decode
from panolog.scene.read import read_scene
from panolog.scene.write import no_progress
from tests.prepare.sfm.accuracy import drift, length

KINDS = ("photographs", "shuffled", "second", "third", "sessions", "copies", "video")
_RIGHT = 0.2  # percent of the way
HEAD = ("place", "as", "outcome", "posed", "of", "rms, % of the way", "CPU seconds")
Image = NDArray[np.uint8]


@dataclass(frozen=True)
class Outcome:
    """What became of a capture."""

    place: str
    kind: str
    outcome: str  # right, part (right, but not whole), refused or wrong
    posed: int
    panoramas: int
    drift: float | None  # percent
    cpu: float  # seconds of all cores
    message: str = ""  # of the refusal


def capture(kind: str, count: int) -> list[tuple[str, int]]:
    """The stems and rows of the panoramas of a walk that a capture of a kind has, in the order of names."""
    rows = np.arange(count)
    match kind:
        case "shuffled":
            rows = np.random.default_rng(7).permutation(count)
        case "second" | "third":
            rows = rows[:: 2 + (kind == "third")]
        case "sessions":  # the second with another light, where the first had a gap
            return [(f"{'ab'[turn]}{row:04d}", row) for turn in (0, 1) for row in range(turn, count, 3)]
    return [(f"{place:04d}", int(row)) for place, row in enumerate(rows)]


def other_light(picture: Image, seed: int) -> Image:
    """A picture (H, W, 3) with other tones, soft shading, blur and noise."""
    random = np.random.default_rng(seed)
    tones = 0.85 * (picture / 255.0) ** 1.5 * (1.15, 0.95, 0.75) + 0.03
    size = picture.shape[1::-1]
    shading = cv2.resize(random.uniform(0.6, 1.15, (4, 8)), size, interpolation=cv2.INTER_CUBIC)
    tones = cv2.GaussianBlur(tones * shading[..., None], (0, 0), 0.8) + random.normal(0, 0.02, picture.shape)
    return np.clip(255 * tones, 0, 255).astype(np.uint8)


def lay_out(kind: str, walk: Walk, source: Path) -> tuple[Path, dict[str, int]]:
    """Writes a capture of a walk to the new folder `source`: what `scene sfm` gets, and rows of stems."""
    source.mkdir(parents=True)
    names = dict(capture(kind, len(walk.images)))
    if kind == "video":
        video = as_video(walk, source / "walk.mp4")
        return video, {f"walk_{row:06d}": row for row in names.values()}
    for stem, row in names.items():
        if stem.startswith("b"):
            lit = other_light(np.asarray(decode(walk.images[row], cv2.IMREAD_COLOR), np.uint8), row)
            write_bytes(source / f"{stem}.jpg", cv2.imencode(".jpg", lit)[1].tobytes())
        else:
            (source / f"{stem}{walk.images[row].suffix}").symlink_to(walk.images[row].resolve())
    if kind == "copies":
        for row in range(0, len(walk.images), 3):
            shutil.copyfile(walk.images[row], source / f"copy {row}{walk.images[row].suffix}")
    return source, names


def try_capture(name: str, kind: str, walk: Walk, folder: Path) -> Outcome:
    """Poses of a capture by `panolog scene sfm`."""
    scene = folder / "scene"
    for leftover in (scene, folder / "scene.sfm", folder / "source"):
        shutil.rmtree(leftover, ignore_errors=True)
    source, names = lay_out(kind, walk, folder / "source")
    begin = cpu_seconds()
    try:
        make_scene(source, scene, SfmSettings(), no_progress)
    except InputError as error:
        spent = cpu_seconds() - begin
        return Outcome(name, kind, "refused", 0, len(names), None, spent, str(error))
    made, spent = read_scene(scene), cpu_seconds() - begin
    truth = walk.centers[[names[it.stem] for it in made.panoramas]]
    off = 100 * drift(made.centers, truth) / length(walk.centers)
    posed = len(made.panoramas)
    whole = "right" if posed == len(names) or kind == "video" else "part"
    outcome = whole if off <= _RIGHT else "wrong"
    return Outcome(name, kind, outcome, posed, len(names), off, spent)


def cpu_seconds() -> float:
    """CPU seconds, on all cores, of this process and of those that it has started and that have ended."""
    own, ended = (resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    return own.ru_utime + own.ru_stime + ended.ru_utime + ended.ru_stime


def main(arguments: Sequence[str] | None = None) -> int:
    """The program; returns its exit code."""
    parser = report.parser("places.captures", __doc__, quick=False)
    parser.add_argument("folder", type=Path, metavar="FOLDER", help="for the panoramas and scenes")
    parser.add_argument("--places", nargs="*", choices=LAYOUTS, default=list(LAYOUTS))
    parser.add_argument("--scene", nargs="*", type=Path, default=[], help="with poses that are known well")
    parser.add_argument("--kinds", nargs="*", choices=KINDS, default=["photographs", "shuffled", "video"])
    parser.add_argument("--bare", action="store_true", help="no texture on ground and sky")
    parser.add_argument("--width", type=int, default=1024)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args(arguments)

    def work() -> report.Report:
        found = []
        for name, walk in _walks(options):
            for kind in options.kinds:
                found.append(try_capture(name, kind, walk, options.folder / name / kind))
                print(json.dumps(asdict(found[-1])), file=sys.stderr, flush=True)
        table = report.markdown(HEAD, [tuple(asdict(it).values())[: len(HEAD)] for it in found])
        passed = all(it.outcome != "wrong" for it in found)
        return report.Report({"results": [asdict(it) for it in found]}, table, passed)

    return report.run("places.captures", options, work)


def _walks(options: argparse.Namespace) -> Iterator[tuple[str, Walk]]:
    """The name of each place, and the walk through it, which is rendered when it is its turn."""
    for place in options.places:
        name = f"{place}{'-bare' if options.bare else ''}-{options.width}-{options.seed}"
        folder = options.folder / name
        yield name, shoot(place, folder, bare=options.bare, width=options.width, seed=options.seed)
    for path in options.scene:
        made = read_scene(path)
        rotations = np.stack([it.rotation for it in made.panoramas])
        yield path.resolve().name, Walk(tuple(it.image for it in made.panoramas), made.centers, rotations)


if __name__ == "__main__":
    sys.exit(main())
