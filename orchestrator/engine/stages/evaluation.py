"""What becomes of an evaluation: metrics.json, seams.json, and pictures of panoramas and of faces.

Where levels of detail are in use it is measured in shards, of each of which a file keeps what was measured.
"""

import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from panolog.orchestrator.runs.folder import RunFolder, command_line, write_json
from panolog.orchestrator.runs.records import MeasuresSaved
from panolog.orchestrator.runs.units import means
from panolog.scene.errors import RunError
from panolog.scene.files import write_bytes
from panolog.scene.images import load_view
from panolog.scene.model import Scene
from panolog.scene.ply import ply_header
from panolog.workers.events import Evaluated, Event, LeftOut, LpipsMissing, SeamMeasured
from panolog.workers.seams.schema import Seam, SeamsFile
from panolog.workers.tasks import NOTHING_HELD_OUT, TaskId

_QUALITY = 92  # of the JPEGs
_RULE = 4  # white rows between render and ground truth
Metrics = dict[str, float | None]


@dataclass
class Evaluation:
    """Gathers the events of one evaluation of the model at `ply`, or of a shard of it."""

    scene: Scene
    ply: Path
    width: int  # pixels
    crop_bottom: float  # fraction of the height
    folder: RunFolder | None  # that gets the pictures; None = none are made
    faces: int = 0  # whose seams are measured
    rows: tuple[int, ...] | None = None  # of the panoramas that are measured; None = all that are held out
    detail: float | None = None  # pixels: the levels of detail that are measured; None = the model itself
    views: dict[str, Metrics] = field(default_factory=dict)
    pose_fit: dict[str, Metrics] = field(default_factory=dict)  # at fitted poses, where poses were refined
    lpips_reason: str | None = None
    left_out: dict[str, str] = field(default_factory=dict)  # reason by name of a panorama
    seams: list[Seam] = field(default_factory=list)

    def add(self, event: Event) -> None:
        """Takes an event of `EvaluateSpec.run`. Raises OSError if a picture cannot be written."""
        if isinstance(event, LpipsMissing):
            self.lpips_reason = event.message
        if isinstance(event, LeftOut) and event.view in self._held_out:
            self.left_out[event.view] = event.message
        if isinstance(event, Evaluated):
            self.views[event.view] = event.metrics
            if event.pose_fit is not None:
                self.pose_fit[event.view] = event.pose_fit
            if self.folder is not None:
                self._save_picture(self.folder, event)
        if isinstance(event, SeamMeasured):
            self.seams.append(event.seam)
            if self.folder is not None:
                _save_pictures(self.folder, self.folder.seam(*event.seam.blocks), event.pictures)

    @cached_property
    def _held_out(self) -> set[str]:
        rows = self.scene.test if self.rows is None else self.rows
        return {self.scene.panoramas[row].name for row in rows}

    @property
    def complete(self) -> bool:
        """Whether it has all of its panoramas and seams."""
        return {*self.views, *self.left_out} == self._held_out and len(self.seams) == self.faces

    def save_shard(self, folder: RunFolder, task: TaskId) -> MeasuresSaved:
        """Writes what a shard has measured, and returns the record of it. Raises OSError if it cannot."""
        path, seams = folder.shard(task), [seam.model_dump(mode="json") for seam in self.seams]
        measured = {"views": self.views, "left_out": self.left_out, "lpips_reason": self.lpips_reason}
        folder.make(path.parent)
        write_json(path, measured | {"pose_fit": self.pose_fit, "seams": seams})
        return MeasuresSaved(task, folder.relative(path), len(self._held_out), len(seams))

    def join(self, folder: RunFolder, shards: Iterable[TaskId]) -> None:
        """Takes what all shards have measured.

        Raises OSError if a file cannot be read, RunError if they are of another evaluation.
        """
        for task in shards:
            measured = json.loads(folder.shard(task).read_bytes())
            self.views |= measured["views"]
            self.pose_fit |= measured.get("pose_fit", {})  # older versions have none
            self.left_out |= measured["left_out"]
            self.lpips_reason = self.lpips_reason or measured["lpips_reason"]
            self.seams += map(Seam.model_validate, measured["seams"])
        if not self.complete:
            place, anew = folder.metrics.parent, command_line("eval", folder.root)
            raise RunError(f"{place}: has shards of another evaluation; `{anew}` measures anew")

    def report(self) -> dict[str, Any]:
        """The content of metrics.json."""
        count, sky = ply_header(self.ply)
        detail = {} if self.detail is None else {"detail": self.detail}
        fitted = {"mean": means(self.pose_fit.values()), "views": self.pose_fit}
        return {
            "model": self.ply.name,
            "gaussians": count,
            "sky": sky,
            "bytes": self.ply.stat().st_size,
            "width": self.width,
            "crop_bottom": self.crop_bottom,
            **detail,
            "mean": means(self.views.values()),
            "lpips_reason": self.lpips_reason,
            "left_out": self.left_out,
            "views": self.views,
            **({} if self.scene.test else {"unmeasured": NOTHING_HELD_OUT}),
            **({"pose_fit": fitted} if self.pose_fit else {}),
        }

    def save(self, folder: RunFolder) -> Metrics:
        """Writes seams.json, if any were measured, and metrics.json, whose means it returns.

        Raises OSError if one cannot be written.
        """
        report = self.report()
        folder.make(folder.metrics.parent)
        if self.seams:
            write_json(folder.seams, SeamsFile.of(self.seams).model_dump(mode="json"))
        write_json(folder.metrics, report)
        mean: Metrics = report["mean"]
        return mean

    def _save_picture(self, folder: RunFolder, event: Evaluated) -> None:
        row = next(i for i in self.scene.test if self.scene.panoramas[i].name == event.view)
        truth = load_view(self.scene.panoramas[row], row, self.width).image.numpy()
        render = cv2.imdecode(np.frombuffer(event.png, np.uint8), cv2.IMREAD_COLOR)
        rule = np.full((_RULE, self.width, 3), 255, np.uint8)
        picture = np.concatenate([render, rule, cv2.cvtColor(truth, cv2.COLOR_RGB2BGR)])
        jpeg = bytes(cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])[1])
        path = folder.picture(event.view)
        _save_pictures(folder, path.parent, {path.name: jpeg})


def _save_pictures(folder: RunFolder, place: Path, pictures: Mapping[str, bytes]) -> None:
    folder.make(place)
    for name, content in pictures.items():
        write_bytes(place / name, content)
