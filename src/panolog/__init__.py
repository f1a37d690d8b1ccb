"""PanoLOG: posed 360° panoramas of a large outdoor place to one 3D Gaussian Splatting model.

The names in `__all__` are the Python API. They are imported when they are first used (PEP 562), so that
`import panolog` takes milliseconds and imports no torch.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from panolog.orchestrator.cli.commands.api import evaluate, resume, run, train
    from panolog.orchestrator.runs.config import RunConfig
    from panolog.renderer.camera import Camera
    from panolog.renderer.render import render
    from panolog.scene.errors import (
        ConfigError,
        DeviceError,
        InputError,
        PanologError,
        RunError,
        RunLockedError,
        SceneError,
    )
    from panolog.scene.gaussians import Gaussians
    from panolog.scene.model import Scene
    from panolog.scene.ply import read_ply, write_ply
    from panolog.scene.read import read_scene

    __version__: str

__all__ = [
    "Camera",
    "ConfigError",
    "DeviceError",
    "Gaussians",
    "InputError",
    "PanologError",
    "RunConfig",
    "RunError",
    "RunLockedError",
    "Scene",
    "SceneError",
    "__version__",
    "evaluate",
    "read_ply",
    "read_scene",
    "render",
    "resume",
    "run",
    "train",
    "write_ply",
]

_MODULES = {
    "panolog.orchestrator.cli.commands.api": ("evaluate", "resume", "run", "train"),
    "panolog.orchestrator.runs.config": ("RunConfig",),
    "panolog.renderer.camera": ("Camera",),
    "panolog.renderer.render": ("render",),
    "panolog.scene.gaussians": ("Gaussians",),
    "panolog.scene.model": ("Scene",),
    "panolog.scene.ply": ("read_ply", "write_ply"),
    "panolog.scene.read": ("read_scene",),
}
_HOME = {name: module for module, names in _MODULES.items() for name in names}


def __getattr__(name: str) -> Any:
    if name == "__version__":
        from importlib.metadata import version  # noqa: PLC0415  # takes as long as many a command

        return version("panolog")
    if name not in __all__:
        raise AttributeError(f"module {__name__} has no attribute {name}")
    value = getattr(import_module(_HOME.get(name, "panolog.scene.errors")), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
