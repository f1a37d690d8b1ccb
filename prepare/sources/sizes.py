"""Panoramas of several sizes become panoramas of one: that of the widest, so that nothing is lost.

A picture that lacks a few rows or columns of 2:1 is stretched, as frames of a video are.
"""

from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

import cv2
import numpy as np

from panolog.prepare.panorama_files import PanoramaFile, remade
from panolog.prepare.provenance import MAX_BYTES
from panolog.prepare.video.layout import whole_width
from panolog.prepare.world.cropped import derived
from panolog.prepare.world.exif import read_exif
from panolog.scene.errors import SceneError
from panolog.scene.files import some_of
from panolog.scene.image_files import decode_colors, decode_used, not_a_panorama, read_info, resize_used
from panolog.scene.write import Progress, no_progress

_MOST = 4  # times as wide as another: beyond, one of them is a thumbnail
_JPEG = (".jpg", ".jpeg")


def common_width(sizes: Iterable[tuple[Path, int, int]]) -> int:
    """The width that panoramas are brought to: that of the widest. Args: sizes, of each width and height.

    Raises SceneError: one is not 2:1, or much smaller than another.
    """
    widths = [(_width(*it), it[0]) for it in sizes]
    (least, small), (most, large) = min(widths), max(widths)
    if most > _MOST * least:
        raise SceneError(
            f"{small}: is {least} pixels wide, and {large.name} {most}, more than {_MOST} times as many; "
            "leave it out if it is a thumbnail, or scale one of them"
        )
    return most


def _width(path: Path, width: int, height: int) -> int:
    """Pixels of the panorama that a picture is stretched to. Raises SceneError if it is none."""
    found = whole_width(width, height)
    if found is None:
        raise not_a_panorama(path, width, height)
    return found


def to_one_size(
    panoramas: Sequence[PanoramaFile],
    folder: Path,
    progress: Progress = no_progress,
    note: Callable[[str], None] = no_progress,
) -> tuple[PanoramaFile, ...]:
    """The panoramas, those of another size than the widest ones enlarged, in `folder`.

    What an earlier call has enlarged is not done again. Place, time, exposure and attitude are kept.
    Args: note, called with a line about how many these are.

    Raises SceneError as `common_width`, or if a picture cannot be decoded; OSError if one cannot be written.
    """
    infos = [read_info(panorama.path) for panorama in panoramas]
    width = common_width(
        (panorama.path, info.width, info.height) for panorama, info in zip(panoramas, infos, strict=True)
    )
    size = width, width // 2
    suffixes = {
        row: ".jpg" if panoramas[row].path.suffix.lower() in _JPEG else ".png"
        for row, info in enumerate(infos)
        if (info.width, info.height) != size
    }
    if not suffixes:
        return tuple(panoramas)
    if 3 * size[0] * size[1] > MAX_BYTES:
        raise SceneError(f"{panoramas[0].path}: {size[0]} x {size[1]} pixels are more than any panorama has")
    exifs = {row: read_exif(panoramas[row].path) for row in suffixes}  # not in threads, see there

    def enlarge(row: int, output: Path) -> None:
        path = panoramas[row].path
        used = decode_used(path)
        pixels = np.asarray(cv2.resize(decode_colors(path), size, interpolation=cv2.INTER_CUBIC), np.uint8)
        if used is not None:
            pixels = np.dstack([pixels, np.where(resize_used(used, size), 255, 0).astype(np.uint8)])
        output.write_bytes(derived(path, exifs[row], pixels, suffixes[row]))

    def fits(path: Path) -> bool:
        info = read_info(path)
        return (info.width, info.height) == size

    found = remade(panoramas, suffixes, folder, enlarge, progress, fits)
    names = [panoramas[row].name for row in suffixes]
    note(f"{some_of(names, 'panorama')} of another size than {size[0]} x {size[1]}: scaled to it")
    return found
