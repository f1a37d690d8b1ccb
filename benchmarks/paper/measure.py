"""The quality of a model on the held-out panoramas of its scene."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from panolog.orchestrator.engine.driver.job import Job
from panolog.orchestrator.engine.stages.scenes import scene_of
from panolog.orchestrator.runs.folder import RunFolder
from panolog.orchestrator.runs.info import read_info
from panolog.orchestrator.runs.units import means
from panolog.renderer.process import choose_device
from panolog.renderer.render import render_panorama
from panolog.scene.gaussians import Gaussians
from panolog.scene.images import View, load_view
from panolog.scene.model import Scene
from panolog.workers.metrics import measure

Picture = NDArray[np.uint8]  # (H, W, 3) RGB


@dataclass(frozen=True, eq=False)
class Gallery:
    """The held-out panoramas of a scene at the width of training."""

    scene: Scene
    width: int  # pixels
    near: float  # world units
    crop_bottom: float = 0.0  # fraction of the height that takes no part
    device: str = "cpu"

    @staticmethod
    def of(root: Path, device: str) -> "Gallery":
        """Of a run's scene, with the settings of the run. Raises InputError if the scene has changed."""
        info = read_info(RunFolder(root))
        job = Job(RunFolder(root), scene_of(info, RunFolder(root)), info.config)
        crop = info.config.eval.crop_bottom
        return Gallery(job.scene, job.width, job.near, crop, choose_device(device))

    @property
    def rows(self) -> tuple[int, ...]:
        """Of the held-out panoramas."""
        return self.scene.test

    def truth(self, row: int) -> View:
        """A photograph with its mask."""
        return self._truths[row]

    @cached_property
    def _truths(self) -> dict[int, View]:
        return {row: load_view(self.scene.panoramas[row], row, self.width) for row in self.rows}

    def render(self, model: Gaussians, row: int) -> Picture:
        """A model as a panorama sees it."""
        panorama, model = self.scene.panoramas[row], model.to(self.device)
        return render_panorama(model, panorama.rotation, panorama.translation, self.width, self.near)

    def quality(self, model: Gaussians) -> Mapping[str, float | None]:
        """The metrics of a model, without LPIPS: means over the held-out panoramas."""
        found = []
        for row in self.rows:
            view = self.truth(row)
            image = self.render(model, row)
            found.append(measure(image, view.image, view.mask, crop_bottom=self.crop_bottom))
        return means(found)
