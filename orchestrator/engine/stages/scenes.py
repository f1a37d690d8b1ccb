"""The scene of a run, and how its panoramas were captured: measured before Stage I, and learnt in it.

Stage I trains on the scene with what was measured, later stages on the scene with what Stage I has learnt:
blocks agree on both sides of their faces.
"""

from datetime import datetime
from pathlib import Path

from panolog.orchestrator.runs.config import RunConfig
from panolog.orchestrator.runs.folder import RunFolder
from panolog.orchestrator.runs.info import RunInfo
from panolog.scene.errors import SceneError
from panolog.scene.model import Scene
from panolog.scene.read import read_scene
from panolog.scene.stores.url import is_url
from panolog.workers.capture.captured import Captured
from panolog.workers.tasks import COARSE


def scene_of(info: RunInfo, folder: RunFolder) -> Scene:
    """The scene of a run. Raises InputError if it is gone or no longer what the run began with.

    One that the run has made is looked for in its folder, which may have been brought to another place.
    """
    path = info.scene.path
    if not (is_url(path) or Path(path).exists()) and folder.scene.is_dir():
        path = str(folder.scene)
    scene = read_scene(path)
    if scene.fingerprint != info.scene.fingerprint:
        raise SceneError(
            f"{path}: the scene has changed since the run began{_newest(scene, info)}; put back what it"
            " was and resume, or start a new run"
        )
    return divided(scene, info.config)


def divided(scene: Scene, config: RunConfig) -> Scene:
    """The scene of a run with these settings, which may hold nothing out."""
    return scene.without_holdout() if config.holdout == "none" else scene


def _newest(scene: Scene, info: RunInfo) -> str:
    """The file that was written last, if that was after the run began: most likely the cause."""
    files = [file for panorama in scene.panoramas for file in panorama.files]
    written, file = max((file.stat().st_mtime, file) for file in files)
    began = datetime.fromisoformat(info.created.replace("Z", "+00:00")).timestamp()
    return f" ({file.relative_to(scene.root)} was written since)" if written > began else ""


def measured_scene(folder: RunFolder, scene: Scene) -> Scene:
    """The scene as Stage I trains on it. Raises RunError if a file is damaged."""
    return _with(folder.measured, _with(folder.adjusted, scene))


def learnt_scene(folder: RunFolder, scene: Scene) -> Scene:
    """The scene as later stages use it, from when Stage I has ended. Raises as `measured_scene`."""
    return _with(folder.captured(COARSE), measured_scene(folder, scene))


def _with(path: Path, scene: Scene) -> Scene:
    return Captured.load(path).applied(scene) if path.exists() else scene
