"""Runs of panoramas whose poses a fake finds."""

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from shutil import copy, copytree
from typing import Any

import cv2
import numpy as np

from panolog.orchestrator.cli.session import session
from panolog.orchestrator.runs.config import load_config
from panolog.orchestrator.runs.preparation.settings import Options
from panolog.orchestrator.runs.state import ignore
from panolog.prepare.sfm.pipeline import SfmSettings, WithMasks, workspace_folder
from panolog.prepare.sfm.sketch import Sketch
from panolog.prepare.sources.gather import panoramas_in_folder
from panolog.scene.files import write_bytes
from panolog.scene.read import read_scene
from panolog.scene.write import StageProgress
from tests.orchestrator.cli.session.test_session import calibrating

CONFIG = load_config(flags={"width": 64, "iterations": 2, "blocks": "2x1x1", "sky.count": 2})
REPORT = {
    "panoramas": 10,
    "registered": 9,
    "points": 300,
    "weak_links": [],
    "contradictions": [{"between": ["a", "b"]}],
    "left_out": ["2 files (a.heic, b.heic): left out, each HEIC"],
}
Hook = Callable[[str], object]


@dataclass
class Report:
    def lines(self) -> list[str]:
        return ["9 of 10 panoramas have a pose", "contradiction: a and b"]


@dataclass
class FakeSfm:
    """Finds the poses of the town's panoramas in two parts, each of which it keeps in its workspace."""

    town: Path
    at: Hook = ignore  # called with the name of each part before it is done, and of the report
    calls: list[SfmSettings] = field(default_factory=list)
    done: list[str] = field(default_factory=list)
    masks: list[list[tuple[str, int]]] = field(default_factory=list)  # of each call: name and time

    def make_scene(
        self,
        source: Path,
        output: Path,
        settings: SfmSettings,
        progress: StageProgress,
        with_masks: WithMasks,
        memory: int,
        show: Callable[[Sketch], None],
    ) -> Report:
        assert memory > 0
        scene, nothing = read_scene(self.town), np.empty((0, 3))
        names = tuple(panorama.name for panorama in scene.panoramas)
        sketches = {
            "features": Sketch((), nothing, nothing, scene.centers),
            "poses": Sketch(names[:5], scene.centers[:5], scene.points, nothing),
        }
        self.calls.append(settings)
        work = workspace_folder(output.resolve())
        masks = [it.layers["masks"] for it in with_masks(panoramas_in_folder(source)) if "masks" in it.layers]
        self.masks.append([(mask.name, mask.stat().st_mtime_ns) for mask in masks])
        for part in ("features", "poses"):
            progress(part, 0, 10)
            show(sketches[part])
            self.at(part)
            if not (work / part).exists():
                work.mkdir(exist_ok=True)
                (work / part).touch()
                self.done.append(part)
            progress(part, 10, 10)
        copytree(self.town, output)
        for mask in masks:
            (output / "masks").mkdir(exist_ok=True)
            copy(mask, output / "masks")
        self.at("report")
        write_bytes(output / "sfm.json", json.dumps(REPORT).encode())
        write_bytes(output / "sfm.png", bytes(cv2.imencode(".png", np.zeros((8, 8), np.uint8))[1]))
        for file in work.iterdir():
            file.unlink()
        work.rmdir()
        return Report()


def start(
    source: Path | Sequence[Path], root: Path, *, action: Callable[[], object] = ignore, **options: Any
) -> None:
    session.start(source, root, CONFIG, None, ignore, calibrating(action), None, Options(**options))


def resume(root: Path) -> None:
    session.resume(root, None, ignore, calibrating())


class Killed(BaseException):
    """Ends a driver without a record, as far as a process can do that to itself."""


def fails(error: BaseException, moment: str = "poses") -> Hook:
    def fail(at: str) -> None:
        if at == moment:
            raise error

    return fail


def image(path: Path, width: int, height: int) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), np.zeros((height, width, 3), np.uint8))
