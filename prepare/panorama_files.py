"""The panoramas of an unfinished scene: files of images and layers, before it can be read as a scene."""

import os
from collections.abc import Callable, Collection, Generator, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from panolog.prepare.file_kinds import INSP, VIDEOS, converted_here, describe_left_out
from panolog.prepare.provenance import check_panorama_size
from panolog.scene.colmap import read_panoramas
from panolog.scene.errors import SceneError
from panolog.scene.files import atomic, file_of, natural_key, some_of, stem_of
from panolog.scene.image_files import decode, decode_used, decode_with_alpha, read_info
from panolog.scene.pictures.kinds import require_panorama
from panolog.scene.read import check_names, image_folder, model_folder
from panolog.scene.write import Progress

_THREADS = min(4, os.cpu_count() or 1)  # each holds a whole panorama
_ADDED = ("@eaDir", "__MACOSX")  # folders of Synology's thumbnails and of macOS's archives
SUFFIXES = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".webp", ".bmp")  # the likeliest first
In = TypeVar("In")
Out = TypeVar("Out")


@dataclass(frozen=True)
class PanoramaFile:
    """The file of a panorama."""

    root: Path  # of its scene
    name: str  # relative to the image folder
    path: Path
    source: str = ""  # the label of what it was taken from, where there are several
    layers: Mapping[str, Path] = field(default_factory=dict, hash=False)  # those that it has, by folder

    def layer(self, folder: str) -> Path:
        """The file of a layer: SCENE/FOLDER/STEM.png."""
        return self.root / folder / f"{stem_of(self.name)}.png"

    def colmap_layer(self, folder: str) -> Path:
        """The other name of a layer: SCENE/FOLDER/NAME.png, as COLMAP names masks."""
        return self.root / folder / f"{self.name}.png"


@dataclass(frozen=True)
class FolderContent:
    """What is below a folder."""

    images: list[Path]  # in the natural order of their paths
    videos: list[Path]  # the same
    left_out: list[str]  # what else of cameras is there, one line for each kind


def pictures_below(source: Path) -> Path:
    """Where the pictures of a folder are: in its folder images or imgs, or in itself."""
    return next((source / name for name in ("images", "imgs") if (source / name).is_dir()), source)


def look_into(folder: Path, used: Collection[str] = ()) -> FolderContent:
    """The image files and videos below a folder, also behind links to folders, and what is left out.

    That are files of other kinds than images, and what systems add: hidden files, such as macOS's
    `._NAME.jpg`, hidden folders, such as `.thumbnails`, and thumbnails of network disks.

    Args: used, suffixes in lower case of files that are read as well. Those of pictures are images.
    """
    files, hidden, seen = list[Path](), list[str](), set[Path]()
    for place, folders, names in os.walk(folder, followlinks=True):
        here = Path(place)
        if here.resolve() in seen:  # a link to a folder above
            folders.clear()
            continue
        seen.add(here.resolve())
        added = any(_is_added(part) for part in here.relative_to(folder).parts)
        links = {it for it in folders if (added or _is_added(it)) and (here / it).is_symlink()}
        folders[:] = [
            it for it in folders if it not in links
        ]  # they may lead to panoramas, which are not hidden
        for path in (here / name for name in names):
            if not added and not _is_added(path.name):
                files.append(path)
            elif path.suffix.lower() in SUFFIXES:
                hidden.append(path.relative_to(folder).as_posix())
    kinds = {*SUFFIXES, *{*converted_here(), INSP}.intersection(used)}
    images = [path for path in files if path.suffix.lower() in kinds and path.is_file()]
    videos = [path for path in files if path.suffix.lower() in VIDEOS and path.is_file()]
    left_out = describe_left_out(sorted(it for it in files if it.suffix.lower() not in used), folder)
    if hidden:
        left_out.append(f"{some_of(sorted(hidden))}: left out, as hidden files and thumbnails are")

    def in_order(paths: list[Path]) -> list[Path]:
        return sorted(paths, key=lambda path: natural_key(path.relative_to(folder).as_posix()))

    return FolderContent(in_order(images), in_order(videos), left_out)


def _is_added(name: str) -> bool:
    """Whether a system has added a file or folder of that name."""
    return name.startswith(".") or name in _ADDED


def masks_among(images: Iterable[Path]) -> dict[Path, Path]:
    """The masks next to panoramas, by panorama: NAME_mask.png of NAME.jpg or another picture."""
    by_stem = {stem_of(str(path)): path for path in images}
    owners = ((stem.removesuffix("_mask"), stem) for stem in by_stem if stem.endswith("_mask"))
    return {by_stem[own]: by_stem[stem] for own, stem in owners if own in by_stem}


def list_panoramas(scene: Path) -> list[PanoramaFile]:
    """All panoramas in the image folder of a scene, by name; no model is needed.

    Raises SceneError: there are none, or two differ only in their suffix.
    """
    root = scene.resolve()
    folder = image_folder(root)
    files = look_into(folder).images
    masks = set(masks_among(files).values())
    files = [path for path in files if path not in masks]
    names = [path.relative_to(folder).as_posix() for path in files]
    if not names:
        raise SceneError(f"{folder}: there are no panoramas in it ({', '.join(sorted(SUFFIXES))})")
    check_names(folder, names)
    return [PanoramaFile(root, name, path) for name, path in zip(names, files, strict=True)]


def list_posed_panoramas(scene: Path) -> list[PanoramaFile]:
    """The panoramas that the scene's model has, by name.

    Raises SceneError: there is no model, it is damaged, or it names a picture that is missing.
    """
    root = scene.resolve()
    where = model_folder(root)
    names = [image.name for image in read_panoramas(where).images]
    check_names(where, names)
    folder = image_folder(root)
    pictures = [PanoramaFile(root, name, file_of(folder, name)) for name in names]
    for picture in pictures:
        if not picture.path.is_file():
            raise SceneError(f"{picture.path}: the model names this image, but it is missing")
    return pictures


def load_resized(path: Path, width: int) -> NDArray[np.uint8]:
    """(width / 2, width, 3) RGB of a panorama, its EXIF orientation left alone.

    What is transparent has the colour of the nearest pixel that is not, so that it has no edge.

    Raises SceneError: it is damaged, not 2:1, shows fisheye circles or two eyes, or is larger than any
    panorama.
    """
    info = read_info(path)
    check_panorama_size(path, info)
    pixels, used = decode_with_alpha(path, width, quick=True)
    require_panorama(path, np.asarray(cv2.cvtColor(pixels, cv2.COLOR_RGB2GRAY), np.uint8))
    return pixels if used is None else _filled(pixels, used)


def load_grey(path: Path) -> tuple[NDArray[np.uint8], NDArray[np.bool_] | None]:
    """(H, W) grey levels of a panorama, whose transparent pixels have no edge as in `load_resized`.

    And (H, W) True = use, if some pixels are transparent. Raises SceneError as `load_resized` does.
    """
    info = read_info(path)
    check_panorama_size(path, info)
    grey = decode(path, cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION)
    require_panorama(path, grey)
    used = decode_used(path) if info.alpha else None
    return (grey, None) if used is None else (_filled(grey, used), used)


def _filled(pixels: NDArray[np.uint8], used: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """Pixels (H, W) or (H, W, 3) in which those that are not used are as the nearest of those that are."""
    if not used.any():
        return pixels
    _, labels = cv2.distanceTransformWithLabels(
        (~used).astype(np.uint8), cv2.DIST_L2, 3, labelType=cv2.DIST_LABEL_PIXEL
    )
    of_label = np.zeros(int(labels.max()) + 1, np.int64)
    of_label[labels[used]] = np.flatnonzero(used)
    filled = pixels.copy()
    filled[~used] = pixels.reshape(used.size, *pixels.shape[2:])[of_label[labels[~used]]]
    return filled


def remade(
    panoramas: Sequence[PanoramaFile],
    suffixes: Mapping[int, str],
    folder: Path,
    write: Callable[[int, Path], None],
    progress: Progress,
    fits: Callable[[Path], bool] = lambda _: True,
) -> tuple[PanoramaFile, ...]:
    """The panoramas, of which some are other files in `folder`, with the times of those that are given.

    What an earlier call has made of a file that has not changed since is not made again, if it fits.
    Args: suffixes, of the files that are made, by row; write, called with a row and the path to write to, in
        threads; fits, whether a file that is there is as it is to be.

    Raises what `write` raises, and OSError.
    """

    def made(row: int) -> PanoramaFile:
        panorama = panoramas[row]
        if row not in suffixes:
            return panorama
        name = f"{stem_of(panorama.name)}{suffixes[row]}"
        output, changed = folder / name, panorama.path.stat().st_mtime_ns
        if not (output.is_file() and output.stat().st_mtime_ns == changed and fits(output)):
            output.parent.mkdir(parents=True, exist_ok=True)
            with atomic(output) as temporary:
                write(row, temporary)
                os.utime(temporary, ns=(changed, changed))
        return replace(panorama, name=name, path=output)

    found = list[PanoramaFile]()
    with ThreadPoolExecutor(_THREADS, "remade") as pool:
        for panorama in pool.map(made, range(len(panoramas))):
            found.append(panorama)
            progress(len(found), len(panoramas))
    return tuple(found)


def prefetch(function: Callable[[In], Out], items: Iterable[In]) -> Generator[tuple[In, Out], None, None]:
    """Each item with `function` of it; meanwhile `function` of the next item runs in a thread.

    Its thread ends with the last item, or when the generator is closed. Raises the exceptions of `function`,
    when the item is yielded.
    """
    with ThreadPoolExecutor(1, "prefetch") as pool:
        waiting = None
        for item in items:
            following = (item, pool.submit(function, item))
            if waiting is not None:
                yield waiting[0], waiting[1].result()
            waiting = following
        if waiting is not None:
            yield waiting[0], waiting[1].result()
