"""What a scene must be before hours of work start; each complaint is one line."""

from collections import Counter
from collections.abc import Sequence
from pathlib import Path, PurePosixPath

import numpy as np
from numpy.typing import NDArray

from panolog.scene.colmap import PanoramaModel
from panolog.scene.errors import SceneError
from panolog.scene.image_files import read_info

MIN_CAMERAS = 2  # one panorama has no parallax
MIN_POINTS = 4  # a point's initial scale comes from its three nearest neighbours


def check_geometry(where: Path, model: PanoramaModel) -> None:
    """Checks cameras and points of the model read from `where`.

    Raises:
        SceneError: fewer than two cameras, too few points, or numbers that are not finite.
    """
    if len(model.names) < MIN_CAMERAS:
        raise SceneError(f"{where}: {len(model.names)} posed panoramas; at least {MIN_CAMERAS} are needed")
    if not (np.isfinite(model.rotations).all() and np.isfinite(model.translations).all()):
        raise SceneError(f"{where}: a pose is not finite; remove that image or repair its pose")
    if len(model.points) < MIN_POINTS:
        raise SceneError(
            f"{where}: the sparse cloud has {len(model.points)} points; at least {MIN_POINTS} are needed, "
            "triangulate them first"
        )
    if not np.isfinite(model.points).all():
        raise SceneError(f"{where}: a point of the sparse cloud is not finite; remove it")


def check_training(where: Path, centers: NDArray[np.float64]) -> None:
    """Checks the cameras of the training split of the scene in `where`; `centers` (K, 3) in world units.

    Raises:
        SceneError: fewer than two cameras, or all at one place.
    """
    if len(centers) < MIN_CAMERAS:
        raise SceneError(
            f"{where}: the train split has {len(centers)} panoramas; at least {MIN_CAMERAS} are needed, "
            "add some or change train.txt or test.txt"
        )
    if np.ptp(centers, axis=0).max() <= 1e-9 * np.abs(centers).max():
        raise SceneError(
            f"{where}: all panoramas of the train split have the same position; "
            "without parallax there is no depth"
        )


def check_names(where: Path, names: Sequence[str]) -> None:
    """Checks that names of panoramas stay in the image folder and that their stems are unique.

    Raises:
        SceneError: an absolute name, one with `..`, or two that differ only in their extension.
    """
    for name in names:
        if PurePosixPath(name).is_absolute() or ".." in PurePosixPath(name).parts:
            raise SceneError(f"{where}: the image name {name} leaves the image folder; make it relative")
    stem, count = Counter(str(Path(name).with_suffix("")) for name in names).most_common(1)[0]
    if count > 1:
        raise SceneError(f"{where}: {count} panoramas are called {stem}; their stems must differ")


def check_images(paths: Sequence[Path]) -> tuple[int, int]:
    """(width, height) that all panoramas share.

    Raises:
        SceneError: a file is missing, truncated or of another size than the first, or they are not 2:1.
    """
    if missing := [path for path in paths if not path.is_file()]:
        more = f" (and {len(missing) - 1} more)" if len(missing) > 1 else ""
        raise SceneError(f"{missing[0]}: the model names this image, but it is missing{more}")
    infos = [read_info(path) for path in paths]
    width, height = infos[0].width, infos[0].height
    for path, info in zip(paths, infos, strict=True):
        if info.width != 2 * info.height:
            raise SceneError(f"{path}: {info.width} x {info.height} pixels are not 2:1, so it is no panorama")
        if info.width != width:
            raise SceneError(
                f"{path}: {info.width} x {info.height} pixels, but {paths[0].name} has {width} x {height}; "
                "all panoramas must have one size"
            )
    return width, height


def check_layer(paths: Sequence[Path | None], bits: int) -> None:
    """Checks masks (8 bit) or depth maps (16 bit): whole, 2:1, of that depth; depth maps have one channel.

    Raises:
        SceneError: one of them is not.
    """
    for path in filter(None, paths):
        info = read_info(path)
        if info.bits != bits:
            raise SceneError(f"{path}: {info.bits} bits a channel, but {bits} are needed; save it so")
        if bits == 16 and info.channels != 1:
            raise SceneError(f"{path}: {info.channels} channels, but a depth map has one; save it as grey")
        if info.width != 2 * info.height:
            raise SceneError(f"{path}: {info.width} x {info.height} pixels are not 2:1 like the panoramas")
