"""What a task of Stage I learns about how its panoramas were captured, between two iterations."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from panolog.renderer.camera import Camera
from panolog.scene.images import View
from panolog.scene.model import Scene
from panolog.workers.capture.captured import Captured
from panolog.workers.capture.config import CaptureConfig
from panolog.workers.capture.exposure import Exposures
from panolog.workers.capture.movers import Movers, Visit
from panolog.workers.capture.poses import Poses


class Learning:
    """The parts that a task learns; those that it does not stay as the scene has them."""

    def __init__(
        self,
        scene: Scene,
        views: Sequence[int],
        config: CaptureConfig,
        device: str,
        *,
        learns: bool,
        width: int,
        iterations: int,
    ) -> None:
        """Nothing is learnt yet.

        Args: views, rows of scene.panoramas; learns, False for tasks that keep what Stage I has learnt; width
        of the views at last, in pixels; iterations of the task.
        """
        self._config, self._iterations = config, iterations
        self._scene, self._views = scene, tuple(views)
        given = scene, self._views
        self.exposure = Exposures.of(*given, config.exposure, device) if learns else None
        self.poses = Poses.of(*given, config.poses, iterations) if learns else None
        self.movers = Movers.of(*given, config.movers, device, width, iterations) if learns else None

    def camera(self, row: int, width: int) -> Camera:
        """The camera of a panorama as known now."""
        panorama = self._scene.panoramas[row]
        pose = (panorama.rotation, panorama.translation) if self.poses is None else self.poses.of_view(row)
        return Camera.of(*pose, width, width // 2)

    def moving(self, iteration: int) -> bool:
        """Whether an iteration has to tell how its camera should move."""
        return self.poses is not None and self.poses.moves(iteration)

    def learn_motion(self, row: int, iteration: int, sums: NDArray[np.float64]) -> None:
        """Learns from the (27,) sums of `renderer.motion` of an iteration that has taken place."""
        if self.poses is not None:
            self.poses.step(row, iteration, sums)

    def view(self, view: View) -> View:
        """A view with what is known of it now."""
        if self.exposure is not None:
            view = replace(view, exposure=self.exposure.of_view(view.row))
        if self.movers is not None and (still := self.movers.still(view)) is not None:
            view = replace(view, mask=still if view.mask is None else view.mask & still)
        return view

    def step(self, visit: Visit) -> None:
        """Learns from an iteration. On a card nothing here waits for it."""
        done = visit.iteration / self._iterations
        if self.exposure is not None and visit.exposure is not None and done > self._config.exposure.begin:
            self.exposure.step(visit.row, visit.exposure, visit.status)
        if self.movers is not None:
            self.movers.step(visit)

    @property
    def _parts(self) -> tuple[Exposures | Poses | Movers, ...]:
        return tuple(part for part in (self.exposure, self.poses, self.movers) if part is not None)

    def tensors(self) -> dict[str, Tensor]:
        """For a checkpoint, by name."""
        return {name: tensor for part in self._parts for name, tensor in part.tensors().items()}

    def restore(self, tensors: Mapping[str, Tensor]) -> None:
        """The inverse of `tensors`, also among others."""
        for part in self._parts:
            part.restore(tensors)

    def captured(self) -> Captured | None:
        """What was learnt; None if nothing was to be."""
        if not self._parts:
            return None
        rows = np.array(self._views, np.int64)
        ascending = rows.argsort()
        return Captured(
            rows=rows[ascending],
            exposure=None if self.exposure is None else self.exposure.learnt()[ascending],
            poses=None if self.poses is None else self.poses.learnt()[ascending],
            at_bound=None if self.poses is None else self.poses.at_bound()[ascending],
            movers=None if self.movers is None else self.movers.learnt()[ascending],
        )
