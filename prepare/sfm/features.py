"""SIFT features of panoramas, found in conformal views, outside of their masks."""

import ctypes
import os
import signal
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from itertools import islice
from multiprocessing import get_context
from pathlib import Path

import numpy as np
import pycolmap
from numpy.typing import NDArray

from panolog.prepare.panorama_files import load_grey
from panolog.prepare.provenance import read_mask
from panolog.prepare.sfm.faces import BAND, DOWN, UP, Faces
from panolog.prepare.sfm.workspace import Workspace
from panolog.scene.write import StageProgress

_PR_SET_PDEATHSIG = 1  # of prctl(2): without it the processes of a killed parent wait for work for ever
_IN_THE_BAND, _AT_A_POLE = 6144, 1024  # features at most: together COLMAP's default for a picture


@dataclass(frozen=True, eq=False)
class Features:
    """Of one panorama."""

    pixels: NDArray[np.float32]  # (N, 2) with the centre of the first pixel at (0.5, 0.5)
    descriptors: NDArray[np.uint8]  # (N, 128)


def find_features(work: Workspace, masks: list[list[Path]], progress: StageProgress) -> int:
    """Writes the features of all panoramas to the database, if they are not there yet.

    Args: masks, for each panorama its 8-bit layers, 0 = no features here.
    Returns: how many features there are.
    Raises: SceneError, a panorama or a mask is damaged or not 2:1.
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
        todo = [(work.panoramas[row].path, masks[row]) for row in rows]
        for row, features in zip(rows, _in_processes(todo), strict=True):
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
    band, pole = (pycolmap.FeatureExtractor.create(_options(most)) for most in (_IN_THE_BAND, _AT_A_POLE))
    faces = Faces(grey.shape[1])
    pixels, descriptors, sizes = [np.empty((0, 2))], [np.empty((0, 128), np.uint8)], [np.empty(0)]
    for face, extractor in ((BAND, band), (UP, pole), (DOWN, pole)):
        keypoints, described = extractor.extract_from_uint8_array(faces.view(grey, face))
        if len(keypoints):
            table = pycolmap.keypoints_to_matrix(keypoints)  # x, y, scale, orientation
            there, own = faces.to_panorama(table[:, :2], face)
            pixels.append(there[own])
            sizes.append(table[own, 2])
            descriptors.append(np.asarray(described.data)[own])
    order = np.argsort(-np.concatenate(sizes), kind="stable")
    found, words = np.concatenate(pixels)[order], np.concatenate(descriptors)[order]
    kept, where = np.ones(len(found), bool), found / (faces.width, faces.width // 2)
    if used is not None:
        kept &= _sampled(used, where)
    for mask in masks:
        kept &= _sampled(read_mask(mask), where)
    return Features(found[kept].astype(np.float32), np.ascontiguousarray(words[kept]))


def _options(most: int) -> pycolmap.FeatureExtractionOptions:
    options = pycolmap.FeatureExtractionOptions()
    options.num_threads = 1  # several panoramas are processed at a time
    options.use_gpu = False
    options.sift.max_num_features = most
    return options


def _sampled(layer: NDArray[np.bool_], where: NDArray[np.float64]) -> NDArray[np.bool_]:
    """(N,) the layer's pixels at fractions (N, 2) of its width and height."""
    height, width = layer.shape
    column, row = (where * (width, height)).astype(np.int64).T
    found: NDArray[np.bool_] = layer[np.clip(row, 0, height - 1), np.clip(column, 0, width - 1)]
    return found


def _in_processes(panoramas: Sequence[tuple[Path, list[Path]]]) -> Iterator[Features]:
    """`features_of` each, in order, on all cores: in processes, because the detector holds Python's lock.

    The processes have ended when the last comes: a Ctrl-C at their end makes Python 3.11 print a traceback.
    """
    if not panoramas:
        return
    cores = min(os.cpu_count() or 1, len(panoramas))
    with ProcessPoolExecutor(cores, get_context("spawn"), _begin) as pool:
        found = pool.map(features_of, *zip(*panoramas, strict=True))
        yield from islice(found, len(panoramas) - 1)
        last = next(found)
    yield last


def _begin() -> None:
    """Starts a process: it ends with its parent, to which Ctrl-C is left; COLMAP's log is silenced."""
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    pycolmap.logging.minloglevel = pycolmap.logging.FATAL.value
