"""Stitches the pictures of a folder; the lenses that it finds are kept next to the panoramas."""

import os
from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from panolog.prepare.file_kinds import INSP
from panolog.prepare.panorama_files import look_into, masks_among
from panolog.prepare.provenance import MAX_BYTES
from panolog.prepare.stitching.calibrate import AGREED, Lenses, OverlapError, calibrate, disagreement
from panolog.prepare.stitching.circles import CircleError, Picture, halves
from panolog.prepare.stitching.lenses import APPROXIMATE, Pair, Up, pairs_as_json, read_pairs
from panolog.prepare.stitching.light import fall_off
from panolog.prepare.stitching.stitch import Stitcher
from panolog.prepare.world.exif import camera_of, essential_exif
from panolog.prepare.world.image_blocks import with_metadata
from panolog.scene.errors import SceneError
from panolog.scene.files import atomic, write_bytes
from panolog.scene.image_files import decode, decode_colors, read_info, resize
from panolog.scene.pictures.kinds import STITCH_THERE, describe_picture
from panolog.scene.write import Progress, no_progress

LENSES = "lenses.json"
_SAMPLED = 8  # pictures in which the lenses are looked for
_SIDE = 2048  # pixels of a lens's picture in which that is done, at most
_QUALITY = 95
Key = tuple[str, int, int]  # of a camera, and the width and height of its pictures


def raw_pictures(folder: Path) -> list[Path]:
    """The pictures of two fisheye circles below a folder; none if its first picture is something else.

    Raises SceneError if a picture is damaged.
    """
    images = look_into(folder, {INSP}).images
    masks = masks_among(images).values()
    found = [it for it in images if it not in masks]
    first = next((it for it in found if it.suffix.lower() != INSP), None)
    if first is not None and not shows_circles(first):
        return []
    return [it for it in found if it.suffix.lower() == INSP or shows_circles(it)]


def shows_circles(path: Path) -> bool:
    """Whether a picture shows two fisheye circles. Raises SceneError if it is damaged."""
    info = read_info(path)
    if info.width * info.height * 3 > MAX_BYTES or min(info.width, info.height) < 16:
        return False
    reduced = cv2.IMREAD_REDUCED_GRAYSCALE_8 if info.height > 2048 else cv2.IMREAD_GRAYSCALE
    return circles_in(np.asarray(decode(path, reduced | cv2.IMREAD_IGNORE_ORIENTATION), np.uint8))


def circles_in(grey: Picture) -> bool:
    """Whether a picture (H, W) shows two fisheye circles, also if there is a dark rim below them."""
    side = grey.shape[1] // 2
    square = grey[:side] if side < grey.shape[0] < grey.shape[1] else grey
    return (describe_picture(square) or "").startswith("two fisheye circles")


def find_pairs(files: Sequence[Path], known: Sequence[Pair] = (), up: Up | None = None) -> dict[Path, Pair]:
    """The lenses with which each picture was made: those that are known, or found in the pictures.

    Raises:
        SceneError: pictures are damaged, or do not show whole circles, or too little in both of them.
    """
    cameras = defaultdict[Key, list[Path]](list)
    for file in files:
        info = read_info(file)
        cameras[camera_of(file), info.width, info.height].append(file)
    found = {}
    for (camera, width, height), pictures in cameras.items():
        size = (width // 2, height) if width > height else (width, height // 2)
        pair = next((it for it in known if (it.camera, it.size) == (camera, size)), None)
        if pair is None:
            chosen = [pictures[row] for row in _spread(len(pictures))]
            pair = replace(
                lenses_in(chosen[0], size, [reduced(decode_colors(it)) for it in chosen]), camera=camera
            )
        pair = pair if up is None else replace(pair, up=up)
        found.update(dict.fromkeys(pictures, pair))
    return found


def lenses_in(source: Path, size: tuple[int, int], pictures: Sequence[Lenses]) -> Pair:
    """The lenses that made pictures, as `reduced` gives them, whose own width and height are `size`.

    Raises SceneError, which names `source`.
    """
    try:
        pair = calibrate(pictures)
        pair = replace(pair, fall=fall_off(pair, pictures))
    except (CircleError, OverlapError) as error:
        raise SceneError(
            f"{source}: its two fisheye circles cannot be stitched: {error}; or {STITCH_THERE}"
        ) from error
    return pair.resized(size)


def stitch_pictures(
    files: Sequence[Path],
    root: Path,
    output: Path,
    *,
    width: int | None = None,
    up: Up | None = None,
    progress: Progress = no_progress,
    note: Callable[[str], None] = no_progress,
) -> list[Path]:
    """Writes the panorama of each picture below `root` to the same place below `output`, as JPEG.

    What an earlier call has finished with the same lenses, which are in `output`/lenses.json, is left.

    Args:
        width: pixels; by default all that the lenses resolve, of several cameras those with the fewest.
        up: where up is in the first circle; by default as in lenses.json, or else up.
        note: called with a line about how exact the panoramas are, and about each picture in which both
            lenses do not agree.

    Raises:
        SceneError: `output` has other files, two panoramas had the same name, or as `find_pairs`.
        OSError: a file cannot be written.
    """
    targets = {file: (output / file.relative_to(root)).with_suffix(".jpg") for file in files}
    if len(set(targets.values())) < len(files):
        raise SceneError(f"{root}: pictures differ only in their suffix; rename them")
    check_folder(output)
    known = read_pairs(output / LENSES)
    pairs = find_pairs(files, known, up)
    distinct = list(dict.fromkeys(pairs.values()))
    if distinct != known:
        output.mkdir(parents=True, exist_ok=True)
        write_bytes(output / LENSES, pairs_as_json(distinct))
    note(APPROXIMATE)
    width = width or min(pair.width for pair in distinct)
    stitchers = {pair: Stitcher(pair, width) for pair in distinct}
    for done, (file, target) in enumerate(targets.items(), 1):
        stitcher = stitchers[pairs[file]]
        changed = file.stat().st_mtime_ns
        finished = stitcher.pair in known and target.is_file() and target.stat().st_mtime_ns == changed
        if not finished or read_info(target).width != stitcher.width:
            _stitch(file, target, stitcher, changed, note)
        progress(done, len(targets))
    return list(targets.values())


def check_folder(output: Path) -> None:
    """Refuses a folder with files of others. Raises SceneError."""
    if output.is_dir() and any(output.iterdir()) and not (output / LENSES).is_file():
        raise SceneError(f"{output}: has other files; give a new folder for the panoramas")


def _stitch(file: Path, target: Path, stitcher: Stitcher, changed: int, note: Callable[[str], None]) -> None:
    """Writes a panorama, with the time of its picture."""
    picture = decode_colors(file)
    both = reduced(picture)
    off = disagreement(stitcher.pair.resized((both[0].shape[1], both[0].shape[0])), both)
    if off is not None and off > np.rad2deg(AGREED):
        note(
            f"{file.name}: the two lenses differ by {off:.1f} degrees where both see; what is there is near, "
            "or the picture is of another camera"
        )
    whole = stitcher.panorama(halves(picture))
    jpeg = bytes(cv2.imencode(".jpg", whole, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])[1])
    jpeg = with_metadata(jpeg, essential_exif(file), None)
    target.parent.mkdir(parents=True, exist_ok=True)
    with atomic(target) as temporary:
        temporary.write_bytes(jpeg)
        os.utime(temporary, ns=(changed, changed))


def reduced(picture: Picture) -> Lenses:
    """The pictures of both lenses in one of both, small enough to look for them."""
    one, other = halves(picture)
    factor = min(1.0, _SIDE / max(one.shape[:2]))
    size = round(one.shape[1] * factor), round(one.shape[0] * factor)
    return resize(one, size), resize(other, size)


def _spread(count: int) -> list[int]:
    """Rows of up to `_SAMPLED` of so many, from the first to the last, and two that follow each other."""
    if count <= _SAMPLED:
        return list(range(count))
    first = np.linspace(0, count - 2, _SAMPLED // 2).round().astype(int)
    return [int(row) + turn for row in first for turn in (0, 1)]
