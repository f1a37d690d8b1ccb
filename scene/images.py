"""Panoramas for training: decoded in the background, resized, kept within a memory budget."""

import logging
import os
from collections import OrderedDict
from collections.abc import Iterable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from types import TracebackType

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from panolog.scene.errors import ConfigError
from panolog.scene.files import Locate, here
from panolog.scene.image_files import decode, decode_panorama, resize
from panolog.scene.model import Panorama, Scene

_THREADS = min(4, os.cpu_count() or 1)  # decoding keeps up with training long before this
_LOG = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class View:
    """One panorama, decoded at the training size, on the CPU."""

    row: int  # of Scene.panoramas
    image: Tensor  # (H, W, 3) uint8 RGB
    mask: Tensor | None  # (H, W) bool, True = use
    sky: Tensor | None  # (H, W) bool, True = sky
    inverse_depth: Tensor | None  # (H, W) float32 in [0, 1], before the affine of eq. 4; 0 = sky or invalid


class PanoramaCache:
    """The views of some panoramas of a scene, the least recently used dropped first.

    For one thread; decoding runs in others. With `prefetch` before each `get` only the first `get` waits.
    A budget below one view still works: each view is then decoded when it is requested.
    """

    def __init__(
        self, scene: Scene, rows: Sequence[int], width: int, budget: int, locate: Locate = here
    ) -> None:
        """Opens nothing yet.

        Args:
            scene: the scene.
            rows: the rows of scene.panoramas that will be requested.
            width: pixels of the views, even and at most the scene's; their height is half of it.
            budget: bytes of decoded views to keep.
            locate: where the scene's files are; called by the threads that decode.

        Raises:
            ConfigError: `width` is odd or more than the panoramas have.
        """
        if width < 2 or width % 2 or width > scene.width:
            raise ConfigError(f"width {width}: give an even number up to {scene.width}, the panoramas'")
        self._panoramas = {row: scene.panoramas[row] for row in rows}
        self._width = width
        self._locate = locate
        largest = max((view_bytes(panorama, width) for panorama in self._panoramas.values()), default=1)
        self._capacity = max(1, budget // largest)
        _LOG.info("image cache: holds %d panoramas of %d at width %d", self._capacity, len(rows), width)
        self._views: OrderedDict[int, Future[View]] = OrderedDict()  # the last is the most recently used
        # One thread for each decode: OpenCV's own would fight with the trainer's for the cores.
        self._pool = ThreadPoolExecutor(_THREADS, "decode", initializer=cv2.setNumThreads, initargs=(1,))

    def prefetch(self, rows: Iterable[int]) -> None:
        """Begins to decode the views that `get` will return next, in that order, as far as they fit."""
        for row in list(dict.fromkeys(rows))[: self._capacity]:
            self._request(row)

    def get(self, row: int) -> View:
        """The view of scene.panoramas[row]; waits until it is decoded.

        Raises:
            SceneError: one of its files cannot be decoded.
            KeyError: `row` is not one of the cache's rows.
        """
        return self._request(row).result()

    def close(self) -> None:
        """Drops all views and ends the threads."""
        self._pool.shutdown(cancel_futures=True)
        self._views.clear()

    def __enter__(self) -> "PanoramaCache":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _request(self, row: int) -> "Future[View]":
        if row not in self._views:
            self._views[row] = self._pool.submit(
                load_view, self._panoramas[row], row, self._width, self._locate
            )
        self._views.move_to_end(row)
        while len(self._views) > self._capacity:
            self._views.popitem(last=False)[1].cancel()
        return self._views[row]


def load_view(panorama: Panorama, row: int, width: int, locate: Locate = here) -> View:
    """Decodes one panorama and what belongs to it, found with `locate`, at (width / 2, width) pixels.

    Raises:
        SceneError: one of its files cannot be decoded.
    """
    image = decode_panorama(locate(panorama.image), width)
    return replace(load_layers(panorama, row, width, locate), image=torch.from_numpy(image))


def load_layers(panorama: Panorama, row: int, width: int, locate: Locate = here) -> View:
    """As `load_view`, but without the picture: `image` has no pixels."""
    size = (width, width // 2)
    mask = sky = depth = None
    if panorama.mask:  # a pixel that mixes in anything to be ignored is to be ignored
        used = np.where(decode(locate(panorama.mask), cv2.IMREAD_GRAYSCALE) > 0, np.float32(1), np.float32(0))
        mask = torch.from_numpy(resize(used, size) > 0.999)
    if panorama.sky_mask:
        foreground = decode(locate(panorama.sky_mask), cv2.IMREAD_GRAYSCALE)
        sky = torch.from_numpy(resize(foreground, size) < 128)
    if panorama.depth:
        raw = decode(locate(panorama.depth), cv2.IMREAD_UNCHANGED)
        depth = torch.from_numpy(_resize_depth(raw, size))
    return View(row, torch.zeros((0, 0, 3), dtype=torch.uint8), mask, sky, depth)


def _resize_depth(raw: NDArray[np.uint16], size: tuple[int, int]) -> NDArray[np.float32]:
    """Raw inverse depth to [0, 1] at `size`; 0 has no value, so only valid pixels enter a mean."""
    values = raw.astype(np.float32) / np.float32(65535)
    weight = resize((raw > 0).astype(np.float32), size)
    total = resize(values, size)
    valid = weight >= 0.5  # at an edge the pixel goes to whichever has most of it
    depth: NDArray[np.float32] = np.divide(total, weight, out=np.zeros_like(total), where=valid)
    return depth


def view_bytes(panorama: Panorama, width: int) -> int:
    """Bytes of one decoded view: three of colour, one a mask, four of depth for each pixel."""
    bytes_per_pixel = 3 + bool(panorama.mask) + bool(panorama.sky_mask) + 4 * bool(panorama.depth)
    return bytes_per_pixel * width * (width // 2)
