"""What each part of the method contributes: one run for each variant, at the same settings.

    python -m benchmarks.quality SCENE -o FOLDER [--width 1024] [--iterations 1500] [--blocks 2x1x1]

Finished variants are not run again: FOLDER keeps the run and the result of each.
"""

import argparse
import json
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from benchmarks import report, runs
from panolog.orchestrator.resources.machine import cores
from panolog.orchestrator.run.folder import RunFolder, write_json
from panolog.orchestrator.run.records import RunBegan
from panolog.orchestrator.run.state import replay
from panolog.scene.errors import InputError, RunError
from panolog.scene.read import read_scene

VARIANTS: dict[str, dict[str, Any]] = {  # in the order of the runs, with the settings that each changes
    "full": {},
    "coarse-only": {"refine": False},
    "position-only": {"partition.tau_grad": 1.0},  # no ratio is above 1 (eq. 11)
    "no-sky": {"sky.count": 0},
    "no-depth": {"depth.w0": 0.0},
}
HEAD = (
    *("variant", "PSNR", "SSIM", "WS-PSNR", "WS-SSIM", "Gaussians", "bytes"),
    *("iterations", "Stage I s", "scoring s", "Stage II s", "total s", "cores", "notes"),
)


@dataclass(frozen=True)
class Settings:
    """The settings of all variants; FOLDER/settings.json."""

    scene: str
    width: int
    iterations: int  # of Stage I and of each block
    blocks: str
    sets: tuple[str, ...]  # KEY=VALUE
    coarse_iterations: int | None  # of coarse-only; None = as many as Stage I and all trained blocks together

    def options(self, variant: str, iterations: int) -> list[str]:
        """The options of `panolog run` for a variant."""
        changes = [f"{key}={json.dumps(value)}" for key, value in VARIANTS[variant].items()]
        sets = [part for setting in (*self.sets, *changes) for part in ("--set", setting)]
        size = ["--width", str(self.width), "--iterations", str(iterations), "--blocks", self.blocks]
        return size + sets


@dataclass(frozen=True)
class Result:
    """One row of the table: means over the held-out panoramas, wall-clock seconds."""

    variant: str
    psnr: float | None  # dB, as ws_psnr
    ssim: float | None
    ws_psnr: float | None
    ws_ssim: float | None
    gaussians: int  # sky included
    bytes: int  # of the PLY
    iterations: int  # of Stage I
    blocks: int  # trained, each for as many iterations as Stage I
    stage1: float
    scoring: float
    stage2: float
    total: float  # with the start of the workers, the merge and the evaluation
    cores: int
    notes: tuple[str, ...]

    def cells(self) -> tuple[object, ...]:
        """The row, in the order of HEAD."""
        steps = f"{self.iterations}" + (f" + {self.blocks} × {self.iterations}" if self.blocks else "")
        seconds = [round(value) for value in (self.stage1, self.scoring, self.stage2, self.total)]
        quality = (self.psnr, self.ssim, self.ws_psnr, self.ws_ssim)
        notes = "; ".join(self.notes)
        return (self.variant, *quality, self.gaussians, self.bytes, steps, *seconds, self.cores, notes)


class Bench:
    """The variants of one scene in one folder."""

    def __init__(self, folder: Path, settings: Settings) -> None:
        """Raises InputError if the folder has results at other settings, or the scene is invalid."""
        self.folder = folder
        self.settings = settings
        self._has_depth = any(panorama.depth for panorama in read_scene(Path(settings.scene)).panoramas)
        _store_settings(folder, settings)

    def result(self, variant: str) -> Result | str:
        """The result of a variant, which runs if it has none yet; or the reason why there is none."""
        if variant == "no-depth" and not self._has_depth:
            return "skipped: the scene has no depth images"
        if known := self._known(variant):
            return known
        try:
            result = self._measure(variant)
        except RunError as error:
            return f"failed: {error}"
        write_json(self._file(variant), asdict(result))
        return result

    def _file(self, variant: str) -> Path:
        return self.folder / f"{variant}.json"

    def _known(self, variant: str) -> Result | None:
        if not self._file(variant).exists():
            return None
        stored = json.loads(self._file(variant).read_bytes())
        return Result(**{**stored, "notes": tuple(stored["notes"])})

    def _measure(self, variant: str) -> Result:
        root, full = self.folder / variant, self._known("full")
        iterations = self._iterations(variant, full)
        if not RunFolder(root).info.exists():
            if full is None or variant != "position-only":
                options = self.settings.options(variant, iterations)
                runs.panolog("run", self.settings.scene, "-o", str(root), *options)
                return self._read(variant, iterations, full)
            runs.borrow_stage_one(self.folder / "full", root, VARIANTS[variant])  # they are those of full
        runs.panolog("resume", str(root))
        return self._read(variant, iterations, full)

    def _iterations(self, variant: str, full: Result | None) -> int:
        """Iterations of Stage I."""
        if variant != "coarse-only":
            return self.settings.iterations
        if self.settings.coarse_iterations is not None:
            return self.settings.coarse_iterations
        if full is None:
            raise RunError("its iterations follow from full: run that too, or give --coarse-iterations")
        return self.settings.iterations * (1 + full.blocks)

    def _read(self, variant: str, iterations: int, full: Result | None) -> Result:
        """The result of a run that has ended."""
        root = self.folder / variant
        records = runs.history(root)
        evaluation = json.loads(runs.panolog("eval", str(root), "--json"))
        seconds = runs.stage_seconds(records)
        total, notes = sum(seconds.values()), []
        if full is not None and "coarse" not in seconds:
            seconds |= {"coarse": full.stage1, "score": full.scoring}
            total += full.stage1 + full.scoring
            notes.append("Stage I and scoring reused from full")
        drivers = sum(isinstance(item.record, RunBegan) for item in records)
        if drivers > 1:
            notes.append(f"interrupted {drivers - 1} times: work done twice counts twice")
        return Result(
            variant,
            **{name: evaluation["mean"][name] for name in ("psnr", "ssim", "ws_psnr", "ws_ssim")},
            gaussians=evaluation["gaussians"],
            bytes=evaluation["bytes"],
            iterations=iterations,
            blocks=sum(block.train for block in replay(records).plan or ()),
            stage1=seconds.get("coarse", 0.0),
            scoring=seconds.get("score", 0.0),
            stage2=seconds.get("block", 0.0),
            total=total,
            cores=cores(),
            notes=tuple(notes),
        )


def _store_settings(folder: Path, settings: Settings) -> None:
    """Stores the settings in the folder. Raises InputError if it holds others."""
    path, wanted = folder / "settings.json", json.loads(json.dumps(asdict(settings)))
    if not path.exists():
        write_json(path, wanted)
        return
    stored = json.loads(path.read_bytes())
    for key, value in wanted.items():
        if stored[key] != value:
            raise InputError(
                f"{folder}: has results with {key} {stored[key]}, not {value}; take another folder"
            )


def table(results: dict[str, Result | str]) -> str:
    """All results in Markdown."""
    blank = [None] * (len(HEAD) - 2)
    rows = [
        (name, *blank, result) if isinstance(result, str) else result.cells()
        for name, result in results.items()
    ]
    return report.markdown(HEAD, rows)


def parse(arguments: Sequence[str] | None = None) -> argparse.Namespace:
    """The command line."""
    parser = report.parser("quality", __doc__, quick=False)
    parser.add_argument("scene", type=Path)
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="FOLDER")
    parser.add_argument("--width", type=int, default=1024, help="of the panoramas, in pixels")
    parser.add_argument("--iterations", type=int, default=1500, help="of Stage I and of each block")
    parser.add_argument("--blocks", default="2x1x1")
    parser.add_argument("--variants", default=",".join(VARIANTS), help="separated by commas")
    parser.add_argument("--set", dest="sets", action="append", default=[], metavar="KEY=VALUE")
    parser.add_argument("--coarse-iterations", type=int, help="of coarse-only; default: those of all stages")
    parsed = parser.parse_args(arguments)
    wanted = parsed.variants.split(",")
    if unknown := set(wanted) - set(VARIANTS):
        parser.error(f"--variants: {', '.join(sorted(unknown))} is none of {', '.join(VARIANTS)}")
    parsed.variants = [name for name in VARIANTS if name in wanted]
    return parsed


def main() -> int:
    """The program; returns its exit code."""
    options = parse()
    settings = Settings(
        str(options.scene.resolve()),
        options.width,
        options.iterations,
        options.blocks,
        tuple(options.sets),
        options.coarse_iterations,
    )

    def work() -> report.Report:
        bench = Bench(options.output, settings)
        results = {variant: bench.result(variant) for variant in options.variants}
        rows = [
            {"variant": variant, "reason": result} if isinstance(result, str) else asdict(result)
            for variant, result in results.items()
        ]
        failed = any(isinstance(result, str) and result.startswith("failed") for result in results.values())
        content = {"settings": asdict(settings), "results": rows}
        return report.Report(content, table(results), passed=not failed)

    try:
        return report.run("quality", options, work)
    except KeyboardInterrupt:
        print("quality: interrupted; the same command continues", file=sys.stderr)
        return 130


if __name__ == "__main__":
    sys.exit(main())
