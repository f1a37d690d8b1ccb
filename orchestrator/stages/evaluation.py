"""What becomes of an evaluation: metrics.json, seams.json, and pictures of panoramas and of faces."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from statistics import fmean
from typing import Any

import cv2
import numpy as np

from panolog.orchestrator.run.folder import RunFolder, write_json
from panolog.scene.files import write_bytes
from panolog.scene.images import load_view
from panolog.scene.model import Scene
from panolog.scene.ply import ply_header
from panolog.workers.events import Evaluated, Event, LeftOut, LpipsMissing, SeamMeasured
from panolog.workers.seams.schema import Seam, SeamsFile

_QUALITY = 92  # of the JPEGs
_RULE = 4  # white rows between render and ground truth
Metrics = dict[str, float | None]


@dataclass
class Evaluation:
    """Gathers the events of one evaluation of the model at `ply`."""

    scene: Scene
    ply: Path
    width: int  # pixels
    crop_bottom: float  # fraction of the height
    folder: RunFolder | None  # that gets the pictures; None = none are made
    faces: int = 0  # whose seams are measured
    views: dict[str, Metrics] = field(default_factory=dict)
    lpips_reason: str | None = None
    left_out: dict[str, str] = field(default_factory=dict)  # reason by name of a panorama
    seams: list[Seam] = field(default_factory=list)

    def add(self, event: Event) -> None:
        """Takes an event of `workers.evaluate.evaluate`. Raises OSError if a picture cannot be written."""
        if isinstance(event, LpipsMissing):
            self.lpips_reason = event.message
        if isinstance(event, LeftOut) and event.view in self._held_out:
            self.left_out[event.view] = event.message
        if isinstance(event, Evaluated):
            self.views[event.view] = event.metrics
            if self.folder is not None:
                self._save_picture(self.folder.picture(event.view), event)
        if isinstance(event, SeamMeasured):
            self.seams.append(event.seam)
            if self.folder is not None:
                _save_pictures(self.folder.seam(*event.seam.blocks), event.pictures)

    @cached_property
    def _held_out(self) -> set[str]:
        return {self.scene.panoramas[row].name for row in self.scene.test}

    @property
    def complete(self) -> bool:
        """Whether it has all held-out panoramas and seams."""
        views = len(self.views) + len(self.left_out)
        return views == len(self.scene.test) and len(self.seams) == self.faces

    def report(self) -> dict[str, Any]:
        """The content of metrics.json."""
        count, sky = ply_header(self.ply)
        return {
            "model": self.ply.name,
            "gaussians": count,
            "sky": sky,
            "bytes": self.ply.stat().st_size,
            "width": self.width,
            "crop_bottom": self.crop_bottom,
            "mean": means(self.views.values()),
            "lpips_reason": self.lpips_reason,
            "left_out": self.left_out,
            "views": self.views,
        }

    def save(self, folder: RunFolder) -> Metrics:
        """Writes seams.json, if any were measured, and metrics.json, whose means it returns.

        Raises OSError if one cannot be written.
        """
        report = self.report()
        if self.seams:
            write_json(folder.seams, SeamsFile.of(self.seams).model_dump(mode="json"))
        write_json(folder.metrics, report)
        mean: Metrics = report["mean"]
        return mean

    def _save_picture(self, path: Path, event: Evaluated) -> None:
        row = next(i for i in self.scene.test if self.scene.panoramas[i].name == event.view)
        truth = load_view(self.scene.panoramas[row], row, self.width).image.numpy()
        render = cv2.imdecode(np.frombuffer(event.png, np.uint8), cv2.IMREAD_COLOR)
        rule = np.full((_RULE, self.width, 3), 255, np.uint8)
        picture = np.concatenate([render, rule, cv2.cvtColor(truth, cv2.COLOR_RGB2BGR)])
        jpeg = bytes(cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])[1])
        _save_pictures(path.parent, {path.name: jpeg})


def _save_pictures(folder: Path, pictures: Mapping[str, bytes]) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for name, content in pictures.items():
        write_bytes(folder / name, content)


def means(views: Iterable[Mapping[str, float | None]]) -> Metrics:
    """The mean of each metric over the views that have it; None where none has."""
    values: dict[str, list[float]] = {}
    for metrics in views:
        for name, value in metrics.items():
            values.setdefault(name, []).extend([] if value is None else [value])
    return {name: fmean(numbers) if numbers else None for name, numbers in values.items()}
