"""What becomes of an evaluation: metrics.json and pictures of held-out panoramas above their ground truth."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from statistics import fmean
from typing import Any

import cv2
import numpy as np

from panolog.orchestrator.run.folder import RunFolder, write_json
from panolog.scene.files import stem_of, write_bytes
from panolog.scene.images import load_view
from panolog.scene.model import Scene
from panolog.scene.ply import ply_header
from panolog.workers.events import Evaluated, Event, LeftOut, LpipsMissing

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
    images: Path | None  # folder of the pictures; None = none are made
    views: dict[str, Metrics] = field(default_factory=dict)
    lpips_reason: str | None = None
    left_out: dict[str, str] = field(default_factory=dict)  # reason by name of a panorama

    def add(self, event: Event) -> None:
        """Takes an event of `workers.evaluate.evaluate`. Raises OSError if a picture cannot be written."""
        if isinstance(event, LpipsMissing):
            self.lpips_reason = event.message
        if isinstance(event, LeftOut):
            self.left_out[event.view] = event.message
        if isinstance(event, Evaluated):
            self.views[event.view] = event.metrics
            if self.images is not None:
                self._save_picture(self.images, event)

    @property
    def complete(self) -> bool:
        """Whether it has all held-out panoramas."""
        return len(self.views) + len(self.left_out) == len(self.scene.test)

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
        """Writes metrics.json and returns the means. Raises OSError if it cannot be written."""
        report = self.report()
        write_json(folder.metrics, report)
        mean: Metrics = report["mean"]
        return mean

    def _save_picture(self, folder: Path, event: Evaluated) -> None:
        row = next(i for i in self.scene.test if self.scene.panoramas[i].name == event.view)
        truth = load_view(self.scene.panoramas[row], row, self.width).image.numpy()
        render = cv2.imdecode(np.frombuffer(event.png, np.uint8), cv2.IMREAD_COLOR)
        rule = np.full((_RULE, self.width, 3), 255, np.uint8)
        picture = np.concatenate([render, rule, cv2.cvtColor(truth, cv2.COLOR_RGB2BGR)])
        path = folder / f"{stem_of(event.view)}.jpg"
        path.parent.mkdir(parents=True, exist_ok=True)
        write_bytes(path, bytes(cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])[1]))


def means(views: Iterable[Mapping[str, float | None]]) -> Metrics:
    """The mean of each metric over the views that have it; None where none has."""
    values: dict[str, list[float]] = {}
    for metrics in views:
        for name, value in metrics.items():
            values.setdefault(name, []).extend([] if value is None else [value])
    return {name: fmean(numbers) if numbers else None for name, numbers in values.items()}
