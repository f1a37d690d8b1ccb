"""What is measured, before Stage I, of how the panoramas of a scene were captured."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from panolog.orchestrator.runs.config import RunConfig
from panolog.orchestrator.runs.folder import command_line
from panolog.prepare.check.blank import find_blank
from panolog.prepare.check.bundle import MENDS, adjust
from panolog.prepare.check.evidence import read_tracks
from panolog.prepare.check.exposure import describe, differing_exposures, measure_exposures
from panolog.prepare.check.misplaced import find_misplaced
from panolog.prepare.check.residuals import describe as describe_residuals
from panolog.scene.files import some_of
from panolog.scene.model import Scene
from panolog.scene.stores.outline import url_of
from panolog.workers.capture.captured import Captured


@dataclass(frozen=True)
class Measured:
    """What Stage I begins with besides the scene; None where it is as its files have it."""

    captured: Captured | None  # exposures and residuals of the training panoramas
    adjusted: Captured | None  # poses of all panoramas, and points


class Measuring:
    """Measures what a run is to learn, of one scene. SceneError if a panorama or its model is damaged."""

    def __init__(
        self, scene: Scene, config: RunConfig, doing: Callable[[str], None], warn: Callable[[str], None]
    ) -> None:
        """Args: doing, called with what begins; warn, with what the user should read."""
        self._scene, self._config, self._doing, self._warn = scene, config, doing, warn

    def found(self) -> Measured:
        """Measures it: poses first, as exposures are compared where panoramas see the same points."""
        adjusted, residuals = self._poses()
        if adjusted is not None:
            self._scene = adjusted.applied(self._scene)
        self._doing("checking panoramas")
        if names := list(find_misplaced(self._scene)):
            self._warn(
                f"{some_of(names, 'panorama')} not where the poses say; training on that blurs the model: "
                f"`{command_line('scene', 'check', url_of(self._scene.root) or self._scene.root)}` names each"
            )
        if blank := find_blank(self._scene):
            self._warn(f"{some_of(blank, 'panorama')}: black, or of one other colour, which is trained on")
        exposure = self._exposures()
        rows = np.array(self._scene.train, np.int64)
        known = exposure is not None or residuals is not None
        captured = Captured(rows=rows, exposure=exposure, residuals=residuals) if known else None
        return Measured(captured, adjusted)

    def _poses(self) -> tuple[Captured | None, NDArray[np.float64] | None]:
        """Adjusted poses, if they are to move, and (V,) `Captured.residuals` of the training panoramas."""
        scene, settings = self._scene, self._config.poses
        if settings.refine is False or (tracks := read_tracks(scene)) is None:
            return None, None
        self._doing("adjusting poses")
        found, adjusted = adjust(scene, tracks), None
        residuals = found.before
        if not np.isfinite(residuals).any():
            return None, None
        if found.gain >= MENDS:
            rows = np.arange(len(scene.panoramas))
            adjusted = Captured(rows=rows, poses=found.poses, points=found.points, given=scene.poses)
            left = float(np.nanmedian(found.after))
            self._warn(
                f"{describe_residuals(residuals)}; bundle adjustment has brought the median to {left:.2f} px"
            )
            residuals = found.after
        known = residuals[list(scene.train)]
        median = np.median(known[np.isfinite(known)]) if np.isfinite(known).any() else 0.0
        if settings.refine == "auto" and not median > settings.residual:
            return adjusted, None
        self._warn(f"{describe_residuals(residuals)}; Stage I refines the poses")
        return adjusted, known

    def _exposures(self) -> NDArray[np.float64] | None:
        """`Captured.exposure` of the training panoramas; None if exposures are not to be learnt."""
        learn, rows = self._config.exposure.learn, self._scene.train
        if learn is False:
            return None
        self._doing("measuring exposures")
        measure = differing_exposures if learn == "auto" else measure_exposures
        if (found := measure(self._scene, rows)) is None:
            return None
        names = [self._scene.panoramas[row].name for row in rows]
        self._warn(f"{describe(names, found)}; Stage I learns them")
        return np.stack([found.log_gain, np.zeros_like(found.log_gain)], axis=1)
