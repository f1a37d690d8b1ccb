"""What is measured, before Stage I, of how the panoramas of a scene were captured."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from panolog.orchestrator.runs.config import RunConfig
from panolog.orchestrator.runs.folder import command_line
from panolog.prepare.check.blank import find_blank
from panolog.prepare.check.bundle import POSES_OFF, adjust
from panolog.prepare.check.evidence import read_tracks
from panolog.prepare.check.exposure import describe, differing_exposures, measure_exposures
from panolog.prepare.check.misplaced import find_misplaced
from panolog.prepare.check.residuals import describe as describe_residuals
from panolog.scene.files import some_of
from panolog.scene.model import Scene
from panolog.scene.stores.stored_scenes import url_of
from panolog.workers.capture.captured import Captured
from panolog.workers.capture.config import ExposureConfig, PosesConfig


@dataclass(frozen=True)
class Measured:
    """What Stage I begins with besides the scene; None where it is as its files have it."""

    captured: Captured | None  # exposures and residuals of the training panoramas
    adjusted: Captured | None  # poses of all panoramas, and points


Say = Callable[[str], None]


def measure_captures(scene: Scene, config: RunConfig, doing: Say, warn: Say) -> Measured:
    """Measures what a run is to learn: poses first, as exposures are compared where panoramas see one place.

    Args: doing, called with what begins; warn, with what the user should read.
    Raises SceneError if a panorama or the scene's model is damaged.
    """
    adjusted, residuals = _poses(scene, config.poses, doing, warn)
    if adjusted is not None:
        scene = adjusted.applied(scene)
    doing("checking panoramas")
    if names := list(find_misplaced(scene)):
        warn(
            f"{some_of(names, 'panorama')} not where the poses say; training on that blurs the model: "
            f"`{command_line('scene', 'check', url_of(scene.root) or scene.root)}` names each"
        )
    if blank := find_blank(scene):
        warn(f"{some_of(blank, 'panorama')}: black, or of one other colour, which is trained on")
    exposure = _exposures(scene, config.exposure, doing, warn)
    rows = np.array(scene.train, np.int64)
    known = exposure is not None or residuals is not None
    captured = Captured(rows=rows, exposure=exposure, residuals=residuals) if known else None
    return Measured(captured, adjusted)


def _poses(
    scene: Scene, settings: PosesConfig, doing: Say, warn: Say
) -> tuple[Captured | None, NDArray[np.float64] | None]:
    """Adjusted poses, if they are to move, and (V,) `Captured.residuals` of the training panoramas."""
    if settings.refine is False or (tracks := read_tracks(scene)) is None:
        return None, None
    doing("adjusting poses")
    found, adjusted = adjust(scene, tracks), None
    residuals = found.before
    if not np.isfinite(residuals).any():
        return None, None
    if found.gain >= POSES_OFF:
        rows = np.arange(len(scene.panoramas))
        adjusted = Captured(rows=rows, poses=found.poses, points=found.points, given=scene.poses)
        left = float(np.nanmedian(found.after))
        warn(f"{describe_residuals(residuals)}; bundle adjustment has brought the median to {left:.2f} px")
        residuals = found.after
    known = residuals[list(scene.train)]
    median = np.median(known[np.isfinite(known)]) if np.isfinite(known).any() else 0.0
    if settings.refine == "auto" and not median > settings.residual:
        return adjusted, None
    warn(f"{describe_residuals(residuals)}; Stage I refines the poses")
    return adjusted, known


def _exposures(scene: Scene, settings: ExposureConfig, doing: Say, warn: Say) -> NDArray[np.float64] | None:
    """`Captured.exposure` of the training panoramas; None if exposures are not to be learnt."""
    if settings.learn is False:
        return None
    doing("measuring exposures")
    measure = differing_exposures if settings.learn == "auto" else measure_exposures
    if (found := measure(scene, scene.train)) is None:
        return None
    warn(f"{describe([scene.panoramas[row].name for row in scene.train], found)}; Stage I learns them")
    return np.stack([found.log_gain, np.zeros_like(found.log_gain)], axis=1)
