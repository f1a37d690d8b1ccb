"""PanoLOG: posed 360° panoramas of a large outdoor place to one 3D Gaussian Splatting model.

The names in `__all__` are the Python API (docs/api.md), and versions are semantic in exactly these. They are
imported when they are first used (PEP 562), so that `import panolog` takes milliseconds and imports no torch.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from panolog.orchestrator.cli.commands.api import evaluate, resume, run, train
    from panolog.orchestrator.engine.driver.local_pool import local_pool
    from panolog.orchestrator.runs.config import RunConfig, load_config
    from panolog.orchestrator.runs.state import RunState
    from panolog.prepare.importers.import_scene import ImportFormat, import_scene, register_format
    from panolog.prepare.importers.interface import ImportedScene, ImportSource, find_panorama
    from panolog.renderer.camera import Camera
    from panolog.renderer.losses import (
        PhotometricLoss,
        inverse_depth_loss,
        photometric_loss,
        sphere_rows,
        ssim_map,
    )
    from panolog.renderer.poses import smooth_path
    from panolog.renderer.rasterize import Raster, rasterize
    from panolog.renderer.render import Render, render
    from panolog.scene.errors import (
        ConfigError,
        DeviceError,
        InputError,
        MissingPackageError,
        PanologError,
        RunError,
        RunLockedError,
        SceneError,
    )
    from panolog.scene.gaussians import Gaussians
    from panolog.scene.model import Scene
    from panolog.scene.ply import read_ply, write_ply
    from panolog.scene.read import read_scene
    from panolog.scene.write import PosedImage
    from panolog.workers.events import Checkpoint, LeftOut, Notice, Preview, Trained
    from panolog.workers.loop.growth import Clone3DGS, Relocate
    from panolog.workers.loop.views import TrainingView, initial_gaussians, load_views
    from panolog.workers.tasks import Progress

    __version__: str

__all__ = [
    "Camera",
    "Checkpoint",
    "Clone3DGS",
    "ConfigError",
    "DeviceError",
    "Gaussians",
    "ImportFormat",
    "ImportSource",
    "ImportedScene",
    "InputError",
    "LeftOut",
    "MissingPackageError",
    "Notice",
    "PanologError",
    "PhotometricLoss",
    "PosedImage",
    "Preview",
    "Progress",
    "Raster",
    "Relocate",
    "Render",
    "RunConfig",
    "RunError",
    "RunLockedError",
    "RunState",
    "Scene",
    "SceneError",
    "Trained",
    "TrainingView",
    "__version__",
    "evaluate",
    "find_panorama",
    "import_scene",
    "initial_gaussians",
    "inverse_depth_loss",
    "load_config",
    "load_views",
    "local_pool",
    "photometric_loss",
    "rasterize",
    "read_ply",
    "read_scene",
    "register_format",
    "render",
    "resume",
    "run",
    "smooth_path",
    "sphere_rows",
    "ssim_map",
    "train",
    "write_ply",
]

_MODULES = {
    "panolog.orchestrator.cli.commands.api": ("evaluate", "resume", "run", "train"),
    "panolog.orchestrator.engine.driver.local_pool": ("local_pool",),
    "panolog.orchestrator.runs.config": ("RunConfig", "load_config"),
    "panolog.orchestrator.runs.state": ("RunState",),
    "panolog.prepare.importers.import_scene": ("ImportFormat", "import_scene", "register_format"),
    "panolog.prepare.importers.interface": ("ImportSource", "ImportedScene", "find_panorama"),
    "panolog.renderer.camera": ("Camera",),
    "panolog.renderer.losses": (
        "PhotometricLoss",
        "inverse_depth_loss",
        "photometric_loss",
        "sphere_rows",
        "ssim_map",
    ),
    "panolog.renderer.poses": ("smooth_path",),
    "panolog.renderer.rasterize": ("Raster", "rasterize"),
    "panolog.renderer.render": ("Render", "render"),
    "panolog.scene.gaussians": ("Gaussians",),
    "panolog.scene.model": ("Scene",),
    "panolog.scene.ply": ("read_ply", "write_ply"),
    "panolog.scene.read": ("read_scene",),
    "panolog.scene.write": ("PosedImage",),
    "panolog.workers.events": ("Checkpoint", "LeftOut", "Notice", "Preview", "Trained"),
    "panolog.workers.loop.growth": ("Clone3DGS", "Relocate"),
    "panolog.workers.loop.views": ("TrainingView", "initial_gaussians", "load_views"),
    "panolog.workers.tasks": ("Progress",),
}
_HOME = {name: module for module, names in _MODULES.items() for name in names}


def __getattr__(name: str) -> Any:
    if name == "__version__":
        from importlib.metadata import version  # noqa: PLC0415  # takes as long as many a command

        return version("panolog")
    if name not in __all__:
        raise AttributeError(f"module {__name__} has no attribute {name}")
    try:
        value = getattr(import_module(_HOME.get(name, "panolog.scene.errors")), name)
    except ModuleNotFoundError as error:
        from panolog.scene.errors import explained  # noqa: PLC0415

        if (missing := explained(error)) is None:
            raise
        raise missing from error
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
