"""SIFT features of panoramas, found in conformal views, outside of their masks."""

import ctypes
import logging
import os
import signal
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from itertools import islice
from multiprocessing import get_context
from pathlib import Path

import numpy as np
import pycolmap
from numpy.typing import NDArray

from panolog.prepare.panorama_files import load_grey
from panolog.prepare.provenance import read_mask, sampled
from panolog.prepare.sfm.conformal_views import BAND, DOWN, UP, Faces
from panolog.prepare.sfm.workspace import Workspace
from panolog.scene.errors import RunError
from panolog.scene.image_files import read_info
from panolog.scene.write import StageProgress

_PR_SET_PDEATHSIG = 1  # of prctl(2): without it the processes of a killed parent wait for work for ever
_TILE = 6_000_000  # pixels that features are found in at a time: the band of a panorama of 4096 pixels
_IN_THE_BAND, _AT_A_POLE = 6144, 1024  # features at most: together COLMAP's default for a picture
MEMORY = 8 * 2**30  # bytes that processes have together, unless they are given more or less
# Bytes, a little more than measured at 2048 to 8192 pixels: COLMAP, pixels up to those of a tile, all pixels.
_PROCESS, _PER_TILE_PIXEL, _PER_PIXEL = 300_000_000, 190, 20
_WHOLE = 4096 * 2048  # pixels of a panorama whose band is one tile
_LOG = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class Features:
    """The features of one panorama."""

    pixels: NDArray[np.float32]  # (N, 2) with the centre of the first pixel at (0.5, 0.5)
    descriptors: NDArray[np.uint8]  # (N, 128)


def find_features(
    work: Workspace, masks: list[list[Path]], progress: StageProgress, memory: int = MEMORY
) -> int:
    """Writes the features of all panoramas to the database, if they are not there yet.

    Args: masks, for each panorama its 8-bit layers, 0 = no features here; memory, bytes that may be used.
    Returns: how many features there are.
    Raises: SceneError, a panorama or a mask is damaged or not 2:1; RunError, its process is killed.
    """
    reader = pycolmap.ImageReaderOptions()
    reader.camera_model = "EQUIRECTANGULAR"
    pycolmap.Database.open(work.database).close()
    pycolmap.import_images(
        work.database, work.images, pycolmap.CameraMode.SINGLE, work.numbers, options=reader
    )
    ids = work.ids()
    with pycolmap.Database.open(work.database) as database:
        rows = [row for row, number in enumerate(ids) if not database.exists_descriptors(number)]
        done = len(work.numbers) - len(rows)
        progress("features", done, len(work.numbers))
        width = read_info(work.panoramas[0].path).width
        count = processes_for(width, memory, max(1, len(rows)))
        todo = [(work.panoramas[row].path, masks[row]) for row in rows]
        for row, features in zip(rows, _in_processes(todo, count), strict=True):
            number = ids[row]
            descriptors = pycolmap.FeatureDescriptors(
                pycolmap.FeatureExtractorType.SIFT, features.descriptors
            )
            if not database.exists_keypoints(number):
                database.write_keypoints(number, features.pixels)
            database.write_descriptors(number, descriptors)
            done += 1
            progress("features", done, len(work.numbers))
        return int(database.num_keypoints())


def features_of(path: Path, masks: Iterable[Path]) -> Features:
    """The features of one panorama, the strongest of each view, large ones first.

    Raises SceneError as `find_features` does.
    """
    grey, used = load_grey(path)
    faces = Faces(grey.shape[1])
    pixels, descriptors, sizes = [np.empty((0, 2))], [np.empty((0, 128), np.uint8)], [np.empty(0)]
    for face, most in ((BAND, _IN_THE_BAND), (UP, _AT_A_POLE), (DOWN, _AT_A_POLE)):
        view, tiles = faces.view(grey, face), faces.tiles(face, _TILE)
        extractor = pycolmap.FeatureExtractor.create(_options(most // len(tiles)))
        for columns, inner in tiles:
            keypoints, described = extractor.extract_from_uint8_array(np.ascontiguousarray(view[:, columns]))
            if len(keypoints):
                table = pycolmap.keypoints_to_matrix(keypoints)  # x, y, scale, orientation
                table[:, 0] += columns.start
                there, own = faces.to_panorama(table[:, :2], face)
                own &= (table[:, 0] >= inner.start) & (table[:, 0] < inner.stop)
                pixels.append(there[own])
                sizes.append(table[own, 2])
                descriptors.append(np.asarray(described.data)[own])
    order = np.argsort(-np.concatenate(sizes), kind="stable")
    found, words = np.concatenate(pixels)[order], np.concatenate(descriptors)[order]
    kept, where = np.ones(len(found), bool), found / (faces.width, faces.width // 2)
    if used is not None:
        kept &= sampled(used, where)
    for mask in masks:
        kept &= sampled(read_mask(mask), where)
    return Features(found[kept].astype(np.float32), np.ascontiguousarray(words[kept]))


def _options(most: int) -> pycolmap.FeatureExtractionOptions:
    options = pycolmap.FeatureExtractionOptions()
    options.num_threads = 1  # several panoramas are processed at a time
    options.use_gpu = False
    options.sift.max_num_features = most
    return options


def processes_for(width: int, memory: int, panoramas: int) -> int:
    """How many processes find features of panoramas that are `width` pixels wide, in `memory` bytes."""
    pixels = width * width // 2
    each = _PROCESS + _PER_TILE_PIXEL * min(pixels, _WHOLE) + _PER_PIXEL * pixels
    return max(1, min(os.cpu_count() or 1, panoramas, memory // each))


def _in_processes(panoramas: Sequence[tuple[Path, list[Path]]], count: int) -> Iterator[Features]:
    """`features_of` each, in order, in `count` processes, because the detector holds Python's lock.

    Half as many after one was killed. Raises RunError if that is so of the only one.
    """
    done = 0
    while done < len(panoramas):
        try:
            for features in _at_once(panoramas[done:], count):
                yield features
                done += 1
        except BrokenProcessPool as error:
            at = panoramas[done][0]
            if count == 1:
                raise RunError(
                    f"{at}: the process that finds its features was killed, most likely for want of memory; "
                    "end what else needs memory, or make the panoramas smaller, and repeat the command"
                ) from error
            count //= 2
            _LOG.warning(
                "a process that finds features was killed, most likely for want of memory: %d at a time now",
                count,
            )


def _at_once(panoramas: Sequence[tuple[Path, list[Path]]], count: int) -> Iterator[Features]:
    """`features_of` each. Raises BrokenProcessPool if a process ends before its work.

    The processes have ended when the last comes: a Ctrl-C at their end makes Python 3.11 print a traceback.
    """
    with ProcessPoolExecutor(min(count, len(panoramas)), get_context("spawn"), _begin) as pool:
        found = pool.map(features_of, *zip(*panoramas, strict=True))
        yield from islice(found, len(panoramas) - 1)
        last = next(found)
    yield last


def _begin() -> None:
    """Starts a process: it ends with its parent, to which Ctrl-C is left; COLMAP's log is silenced."""
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    pycolmap.logging.minloglevel = pycolmap.logging.FATAL.value
