"""What a model costs in each format of `panolog export`: bytes, seconds, memory, and what it still shows.

    python -m benchmarks.export RUN [--formats sog,web] [--only formats,levels,large] [--gaussians 10000000]

formats: each format of the run's model, written by the public command in a process of its own: bytes,
seconds, peak memory, whether a second export has the same bytes, and the PSNR of renders from the held-out
poses against those of the PLY. levels: the same with all that is far enough for a level of detail replaced by
it, and what it costs to replace nearer things. large: the model repeated side by side until it has so many
Gaussians, in each format.
"""

import argparse
import hashlib
import math
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, astuple, dataclass, fields
from itertools import product
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import torch
from numpy.typing import NDArray

from benchmarks import report
from panolog.export.detail import Detail
from panolog.export.frame import Frame
from panolog.export.georeference import georeference_of
from panolog.export.splats import ModelSource, Selection, Splats
from panolog.orchestrator.commands.models import Axes, as_ply, frame_in, size_of
from panolog.orchestrator.run.folder import RunFolder
from panolog.orchestrator.run.info import read_info
from panolog.orchestrator.stages.scenes import scene_of
from panolog.renderer.render import render_panorama
from panolog.scene.errors import InputError, RunError
from panolog.scene.gaussians import Gaussians, concatenate
from panolog.scene.model import Scene
from panolog.scene.ply import (
    ply_exact,
    ply_header,
    read_ply,
    read_ply_chunks,
    read_sky,
    write_ply_parts,
)

PARTS = ("formats", "levels", "large")
# By name: the options, the ending of the output, and whether `eval` reads it.
FORMATS = {
    "sog": (["--sog"], ".sog", True),
    "sog SH 0": (["--sog", "--sh", "0"], ".sog", True),
    "spz 3": (["--spz"], ".spz", True),
    "spz 4": (["--spz", "--spz-version", "4"], ".spz", True),
    "compressed ply": (["--compressed-ply"], ".compressed.ply", True),
    "glb": (["--glb"], ".glb", False),
    "web": (["--web"], "-web", False),
    "3dtiles": (["--3dtiles"], "-3dtiles", False),
}
_MEASURED = """\
import sys
from benchmarks.processes import peak_memory
from panolog.orchestrator.cli.app import main
try:
    main()
finally:
    print(peak_memory(), file=sys.stderr)
"""
_PIXELS = (2.0, 8.0, 32.0)  # that a cube of a level spans where the level is used: 2 is meant
_POSES = 8  # held-out panoramas that are rendered, at most


@dataclass(frozen=True)
class FormatMeasurement:
    """One format of one model."""

    format: str
    gaussians: int
    megabytes: float
    smaller: float  # times than the PLY
    seconds: float
    peak: float  # MB of resident memory of the process
    same: bool | None  # whether a second export has the same bytes
    psnr: float | None = None  # dB, mean of the renders against those of the PLY
    worst: float | None = None  # dB, of the worst of them


@dataclass(frozen=True)
class LevelMeasurement:
    """One level of detail, seen from where it is used."""

    level: int
    share: float  # of the Gaussians of the model
    side: float  # units, of the cubes that are merged
    pixels: float  # that a cube spans at most
    distance: float  # units, from which on it replaces the model
    replaced: float  # share of the Gaussians that are that far away, mean over the poses
    psnr: float  # dB, mean over the poses


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the benchmark. Returns the exit code."""
    parser = report.parser("export", __doc__, quick=False)
    parser.add_argument("run", type=Path, help="folder of a run, with its scene")
    parser.add_argument("--formats", default=",".join(FORMATS), help="some of them, with commas")
    parser.add_argument("--only", default="formats,levels", help=f"some of {','.join(PARTS)}")
    parser.add_argument("--gaussians", type=int, default=10_000_000, help="of the large model")
    parser.add_argument("--folder", type=Path, help="where files are written; default: the system's")
    options = parser.parse_args(arguments)
    return report.run("export", options, lambda: measure(options))


def measure(options: argparse.Namespace) -> report.Report:
    """All parts that are requested. Raises InputError if the run or an option does not fit."""
    wanted, only = options.formats.split(","), options.only.split(",")
    if unknown := [*(set(wanted) - set(FORMATS)), *(set(only) - set(PARTS))]:
        raise InputError(f"{unknown[0]}: write some of {', '.join([*FORMATS, *PARTS])}")
    folder = RunFolder(options.run)
    scene = scene_of(read_info(folder), folder)
    content, texts = dict[str, object](), list[str]()
    with TemporaryDirectory(dir=options.folder, prefix="panolog-export-") as name:
        scratch = Path(name)
        if "formats" in only:
            found = [_format(folder, scene, kind, scratch) for kind in wanted]
            content["formats"] = [asdict(row) for row in found]
            texts.append(_table(FormatMeasurement, found))
        if "levels" in only:
            levels = _levels(folder, scene, scratch)
            content["levels"] = [asdict(row) for row in levels]
            texts.append(_table(LevelMeasurement, levels))
        if "large" in only:
            large = scratch / "large.ply"
            repeat(folder.point_cloud, large, options.gaussians, georeference_of(scene).up)
            found = [_written(large, kind, scratch, None) for kind in wanted]
            content["large"] = [asdict(row) for row in found]
            texts.append(_table(FormatMeasurement, found))
    return report.Report(content, "\n\n".join(texts))


def _table(kind: type, rows: Sequence[FormatMeasurement] | Sequence[LevelMeasurement]) -> str:
    return report.markdown([field.name for field in fields(kind)], [astuple(row) for row in rows])


def _format(folder: RunFolder, scene: Scene, kind: str, scratch: Path) -> FormatMeasurement:
    """A format of a run's model, and what it still shows."""
    poses = _Poses(folder, scene)
    return _written(folder.root, kind, scratch, poses if FORMATS[kind][2] else None)


def _written(source: Path, kind: str, scratch: Path, poses: "_Poses | None") -> FormatMeasurement:
    arguments, ending, _ = FORMATS[kind]
    ply = RunFolder(source).point_cloud if source.is_dir() else source
    with _export(source, scratch / f"first{ending}", arguments) as first:
        size, digest = sum(map(size_of, first.paths)), _digest(first.paths)
        psnrs = poses.compare(scratch / f"first{ending}", "export") if poses else []
    with _export(source, scratch / f"second{ending}", arguments) as second:
        same = _digest(second.paths) == digest
    count = ply_header(ply)[0]
    return FormatMeasurement(
        kind,
        count,
        size / 1e6,
        ply.stat().st_size / size,
        first.seconds,
        first.peak / 1e6,
        same,
        float(np.mean(psnrs)) if psnrs else None,
        min(psnrs, default=None),
    )


@dataclass(frozen=True)
class _Exported:
    paths: list[Path]
    seconds: float
    peak: int  # bytes


@contextmanager
def _export(source: Path, output: Path, arguments: list[str]) -> Iterator[_Exported]:
    """What the public command writes, until the context ends. Raises RunError if it fails."""
    command = [sys.executable, "-c", _MEASURED, "export", source, "-o", output, *arguments]
    began = time.monotonic()
    ended = subprocess.run(list(map(str, command)), capture_output=True, text=True, check=False)
    seconds = time.monotonic() - began
    *said, peak = ended.stderr.strip().splitlines()
    if ended.returncode:
        raise RunError(said[-1])
    paths = sorted(
        path for path in output.parent.iterdir() if path.name.startswith(output.name.split(".")[0])
    )
    try:
        yield _Exported(paths, seconds, int(peak))
    finally:
        for path in paths:
            if path.is_dir():
                shutil.rmtree(path)
            else:
                path.unlink()


def _digest(paths: Sequence[Path]) -> str:
    """Of all bytes of some files and folders, and the names in these."""
    found = hashlib.sha256()
    for path in paths:
        files = sorted(path.rglob("*")) if path.is_dir() else [path]
        for file in filter(Path.is_file, files):
            found.update(str(file.relative_to(path)).encode() + file.read_bytes())
    return found.hexdigest()


class _Poses:
    """Renders from the held-out poses of a run."""

    def __init__(self, folder: RunFolder, scene: Scene) -> None:
        self._scene, self._width = scene, read_info(folder).config.width or scene.width
        self.exact = ply_exact(folder.point_cloud)
        self.views = [scene.panoramas[row] for row in scene.test[:_POSES]]
        self.whole = read_ply(folder.point_cloud)
        self._true = [self._render(self.whole, index) for index in range(len(self.views))]

    @property
    def pixel(self) -> float:
        """Radians of a pixel at the horizon."""
        return 2 * math.pi / self._width

    def compare(self, path: Path, axes: Axes) -> list[float]:
        """PSNR in dB of each render of a model in a file against that of the run's PLY."""
        with as_ply(path, lambda: frame_in(path, self._scene, axes), exact=self.exact) as ply:
            model = read_ply(ply)
        return [self.psnr(model, index) for index in range(len(self.views))]

    def psnr(self, model: Gaussians, index: int) -> float:
        """The same of one render."""
        apart = self._render(model, index).astype(np.float64) - self._true[index]
        return float(10 * np.log10(255**2 / max(np.square(apart).mean(), 1e-9)))

    def _render(self, model: Gaussians, index: int) -> NDArray[np.uint8]:
        view = self.views[index]
        return render_panorama(model, view.rotation, view.translation, self._width, 0.0)


def _levels(folder: RunFolder, scene: Scene, scratch: Path) -> list[LevelMeasurement]:
    """Each level of detail where its cubes span two pixels, with the model before it."""
    poses = _Poses(folder, scene)
    sky = read_sky(folder.point_cloud)
    source = ModelSource(folder.point_cloud, Selection("scene"), Frame())
    detail = Detail(source, scratch, levels=5)
    leaves = [leaf.levels for leaf in detail.leaves()]
    levels = [Splats.joined([leaf[level] for leaf in leaves]) for level in range(len(detail.sides))]
    found = []
    for (level, side), pixels in product(list(enumerate(detail.sides))[1:], _PIXELS):
        distance, psnrs, shares = side / (pixels * poses.pixel), [], []
        for index, view in enumerate(poses.views):
            near = _apart(levels[0], view.center) < distance
            far = _apart(levels[level], view.center) >= distance
            mixed = Splats.joined([levels[0].select(near), levels[level].select(far)])
            psnrs.append(poses.psnr(concatenate(mixed.gaussians(exact=poses.exact), sky), index))
            shares.append(1 - near.mean())
        share, means = len(levels[level]) / len(levels[0]), (float(np.mean(it)) for it in (shares, psnrs))
        found.append(LevelMeasurement(level, share, side, pixels, distance, *means))
    return found


def _apart(splats: Splats, center: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(np.linalg.norm(splats.means - center, axis=1))


def repeat(source: Path, output: Path, count: int, up: tuple[float, float, float]) -> None:
    """Writes a model of at least so many Gaussians: the scene of a PLY again and again, and its sky.

    Args: up, the copies lie next to each other across it.
    """
    gaussians, sky_count = ply_header(source)
    own = gaussians - sky_count
    copies = -(-count // own)
    across = math.isqrt(copies - 1) + 1
    means = np.concatenate([piece.means.numpy() for piece in read_ply_chunks(source)])[:own]
    low, high = np.quantile(means, [0.02, 0.98], axis=0)
    first, second = (axis for axis in range(3) if axis != int(np.abs(up).argmax()))
    sky = read_sky(source)

    def parts() -> Iterator[Gaussians]:
        for copy in range(copies):
            shift = torch.zeros(3)
            shift[first] = float(high[first] - low[first]) * (copy % across)
            shift[second] = float(high[second] - low[second]) * (copy // across)
            for piece in read_ply_chunks(source):
                scene = piece.select(torch.arange(len(piece)) < len(piece) - piece.sky)
                yield scene.with_tensors(scene.tensors() | {"means": scene.means + shift})
        yield sky

    write_ply_parts(output, parts(), count=copies * own + len(sky), sky=len(sky), exact=ply_exact(source))


if __name__ == "__main__":
    sys.exit(main())
