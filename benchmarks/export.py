"""What a model costs in each format of `panolog export`: bytes, seconds, memory, and what it still shows.

    python -m benchmarks.export RUN [--formats sog,web]

Each format of the run's model is written by the public command in a process of its own: bytes, seconds, peak
memory, whether a second export has the same bytes, and the PSNR of renders from the held-out poses against
those of the PLY.
"""

import argparse
import hashlib
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict, astuple, dataclass, fields
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from benchmarks import report
from panolog.orchestrator.cli.commands.models import as_ply, frame_in, size_of
from panolog.orchestrator.engine.stages.scenes import scene_of
from panolog.orchestrator.runs.folder import RunFolder
from panolog.orchestrator.runs.info import read_info
from panolog.renderer.render import render_panorama
from panolog.scene.errors import InputError, RunError
from panolog.scene.model import Scene
from panolog.scene.ply import ply_exact, ply_header, read_ply

# By name: the options, the ending of the output, and whether `eval` reads it.
FORMATS = {
    "sog": (["--sog"], ".sog", True),
    "sog SH 0": (["--sog", "--sh", "0"], ".sog", True),
    "spz 3": (["--spz"], ".spz", True),
    "spz 4": (["--spz", "--spz-version", "4"], ".spz", True),
    "compressed ply": (["--compressed-ply"], ".compressed.ply", True),
    "ply": (["--ply"], ".ply", True),
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


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the benchmark. Returns the exit code."""
    parser = report.parser("export", __doc__, quick=False)
    parser.add_argument("run", type=Path, help="folder of a run, with its scene")
    parser.add_argument("--formats", default=",".join(FORMATS), help="some of them, with commas")
    parser.add_argument("--folder", type=Path, help="where files are written; default: the system's")
    options = parser.parse_args(arguments)
    return report.run("export", options, lambda: measure(options))


def measure(options: argparse.Namespace) -> report.Report:
    """All formats that are requested. Raises InputError if the run or an option does not fit."""
    wanted = options.formats.split(",")
    if unknown := sorted(set(wanted) - set(FORMATS)):
        raise InputError(f"{unknown[0]}: write some of {', '.join(FORMATS)}")
    folder = RunFolder(options.run)
    scene = scene_of(read_info(folder), folder)
    found = []
    for kind in wanted:
        with TemporaryDirectory(dir=options.folder, prefix="panolog-export-") as scratch:
            found.append(_format(folder, scene, kind, Path(scratch)))
    table = report.markdown(
        [field.name for field in fields(FormatMeasurement)], [astuple(row) for row in found]
    )
    return report.Report({"formats": [asdict(row) for row in found]}, table)


def _format(folder: RunFolder, scene: Scene, kind: str, scratch: Path) -> FormatMeasurement:
    """A format of a run's model, and what it still shows."""
    arguments, ending, readable = FORMATS[kind]
    first, second = (_export(folder.root, scratch / name / f"out{ending}", arguments) for name in "ab")
    size = sum(map(size_of, first.output.parent.iterdir()))
    psnrs = _compare(folder, scene, first.output) if readable else []
    same = _digest(first.output.parent) == _digest(second.output.parent)
    ply = folder.point_cloud
    return FormatMeasurement(
        kind,
        ply_header(ply)[0],
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
    output: Path
    seconds: float
    peak: int  # bytes


def _export(source: Path, output: Path, arguments: list[str]) -> _Exported:
    """Runs the public command, whose output has a folder of its own. Raises RunError if it fails."""
    output.parent.mkdir()
    command = [sys.executable, "-c", _MEASURED, "export", source, "-o", output, *arguments]
    began = time.monotonic()
    ended = subprocess.run(list(map(str, command)), capture_output=True, text=True, check=False)
    seconds = time.monotonic() - began
    *said, peak = ended.stderr.strip().splitlines()
    if ended.returncode:
        raise RunError(said[-1])
    return _Exported(output, seconds, int(peak))


def _digest(folder: Path) -> str:
    """The SHA-256 of the names and bytes of all files in a folder."""
    found = hashlib.sha256()
    for file in sorted(filter(Path.is_file, folder.rglob("*"))):
        found.update(str(file.relative_to(folder)).encode() + file.read_bytes())
    return found.hexdigest()


def _compare(folder: RunFolder, scene: Scene, path: Path) -> list[float]:
    """PSNR in dB of a model in a file against the run's PLY, rendered from each held-out pose."""
    whole, exact = folder.point_cloud, ply_exact(folder.point_cloud)
    width = read_info(folder).config.width or scene.width
    with as_ply(path, lambda: frame_in(path, scene, "export"), exact=exact) as ply:
        models = [read_ply(whole), read_ply(ply)]
    found = []
    for row in scene.test[:_POSES]:
        view = scene.panoramas[row]
        seen, true = (
            render_panorama(model, view.rotation, view.translation, width, 0.0).astype(np.float64)
            for model in models
        )
        found.append(float(10 * np.log10(255**2 / max(np.square(seen - true).mean(), 1e-9))))
    return found


if __name__ == "__main__":
    sys.exit(main())
