"""COLMAP models among what the user gave: where they are, and with which cameras."""

from pathlib import Path

from panolog.scene.colmap_files import read_cameras
from panolog.scene.errors import SceneError


def find_model(folder: Path) -> Path | None:
    """Where in `folder` a COLMAP model is: itself, sparse/0 or sparse; None if nowhere."""
    for candidate in (folder, folder / "sparse" / "0", folder / "sparse"):
        if all(
            any((candidate / f"{stem}{end}").is_file() for end in (".bin", ".txt"))
            for stem in ("cameras", "images")
        ):
            return candidate
    return None


def require_model(folder: Path) -> Path:
    """As `find_model`. Raises SceneError if it is nowhere."""
    found = find_model(folder)
    if found is None:
        raise SceneError(f"{folder}: there is no COLMAP model (cameras and images, .bin or .txt)")
    return found


def camera_models(folder: Path | None) -> set[str]:
    """The camera models of the COLMAP model in `folder`; empty without one, or if its cameras are damaged."""
    try:
        return {camera.model for camera in read_cameras(folder).values()} if folder is not None else set()
    except SceneError:
        return set()
