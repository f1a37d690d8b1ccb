"""What is known of how panoramas were captured, written to a run's folder: as measured, and as learnt."""

import math
from typing import Any

from panolog.orchestrator.engine.stages.measuring import Measured
from panolog.orchestrator.engine.stages.movers import write_movers
from panolog.orchestrator.engine.stages.poses import save_poses
from panolog.orchestrator.runs.folder import RunFolder, write_json
from panolog.scene.model import Panorama, Scene
from panolog.workers.capture.captured import Captured
from panolog.workers.tasks import COARSE


def save_captured(folder: RunFolder, captured: Captured, scene: Scene) -> None:
    """Writes what Stage I has learnt, for later stages and to be read. Raises OSError if that fails."""
    folder.make(folder.captured(COARSE).parent)
    captured.save(folder.captured(COARSE))
    learnt = captured.applied(scene)
    adjusted = Captured.load(folder.adjusted) if folder.adjusted.exists() else None
    if captured.exposure is not None:
        write_json(folder.exposure, {"panoramas": [_exposure(learnt.panoramas[row]) for row in learnt.train]})
    if captured.movers is not None:
        write_movers(folder, learnt)
    if captured.poses is not None:
        save_poses(folder, captured, adjusted, scene)


def save_measured(folder: RunFolder, found: Measured, scene: Scene) -> None:
    """Writes what was measured before Stage I. Args: scene, as its files have it.

    Raises OSError if the disk takes no file, SceneError if the COLMAP model can no longer be read.
    """
    if found.captured is not None:
        found.captured.save(folder.measured)
    if found.adjusted is not None:
        found.adjusted.save(folder.adjusted)
        save_poses(folder, None, found.adjusted, found.adjusted.applied(scene))


def _exposure(panorama: Panorama) -> dict[str, Any]:
    assert panorama.exposure is not None
    log_gain, black = panorama.exposure.tolist()
    return {
        "name": panorama.name,
        "stops": sum(log_gain) / 3 / math.log(2),  # over the mean of all
        "gain": [math.exp(value) for value in log_gain],  # RGB, in linear light
        "black": black,  # RGB, of encoded colours in [0, 1]
    }
