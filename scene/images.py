"""Panoramas for training: decoded in the background, resized, kept within a memory budget.

On a GPU the threads that decode also move each view there (`CudaMover`). As many views as have room stay on
it; of the others those that are used next are there, and the rest waits decoded in the host's memory.
"""

import logging
import os
from collections import OrderedDict
from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from types import TracebackType
from typing import Any, TypeAlias

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from panolog.scene.errors import ConfigError, ImageError
from panolog.scene.files import Locate, here
from panolog.scene.image_files import (
    WHITE,
    decode,
    decode_mask,
    decode_used,
    decode_with_alpha,
    resize,
    resize_used,
)
from panolog.scene.model import Panorama, Scene
from panolog.scene.tensors.decoded import DecodedLayers
from panolog.scene.tensors.transfer import CudaMover, Mover, Moving, pack

_THREADS = min(4, os.cpu_count() or 1)  # on the CPU: decoding keeps up with training long before this
MOST_THREADS = 8  # for a GPU: each holds a pinned view and has one more on the GPU
PASSING = 2  # views on a GPU beyond one for each thread: the one in use, and a preview's
_LAYERS = ("image", "mask", "sky", "inverse_depth", "exposure")
# Of a budget that not all views fit in, for the files of layers: a tenth of a view each.
_LAYERS_SHARE = 0.5
CURVE, TOE = 2.4, 0.055  # of sRGB (IEC 61966-2-1), above its linear part
_grey, _unchanged = partial(decode, flags=cv2.IMREAD_GRAYSCALE), partial(decode, flags=cv2.IMREAD_UNCHANGED)
_LOG = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class View:
    """One panorama, decoded at the training size, on the device of its cache."""

    row: int  # of Scene.panoramas
    image: Tensor  # (H, W, 3) uint8 RGB
    mask: Tensor | None  # (H, W) bool, True = use
    sky: Tensor | None  # (H, W) bool, True = sky
    inverse_depth: Tensor | None  # (H, W) float32 in [0, 1], before the affine of eq. 4; 0 = sky or invalid
    exposure: Tensor | None = None  # (2, 3) float32 RGB: the photograph has [0] · x + [1] of colours x

    @staticmethod
    def of(row: int, layers: Mapping[str, Tensor]) -> "View":
        """The inverse of `layers`."""
        return View(row, layers["image"], *(layers.get(name) for name in _LAYERS[1:]))

    def layers(self) -> dict[str, Tensor]:
        """The layers that the panorama has, by name."""
        return {name: layer for name in _LAYERS if (layer := getattr(self, name)) is not None}


def pixels(layer: Tensor, v: NDArray[np.int64], u: NDArray[np.int64]) -> NDArray[Any]:
    """The values (M, ...) of a layer in rows v and columns u (M,): only they leave its device."""
    at = tuple(torch.from_numpy(index).to(layer.device) for index in (v, u))
    chosen: NDArray[Any] = layer[at].cpu().numpy()
    return chosen


# The decoded view, if it is to be kept; the one for the device, and on a GPU what it waits for.
_Loaded: TypeAlias = "Future[tuple[View | None, View, Moving | None]]"


class PanoramaCache:
    """The views of some panoramas of a scene, on one device.

    For one thread; decoding runs in others. With `prefetch` before each `get` only the first `get` waits.
    A budget below one view still works: each view is then decoded when it is requested.

    The least recently used views are dropped first, except on a GPU: there those that come first stay while
    there is room. An epoch uses each view once, in another order, so no other choice would hit more often.
    """

    def __init__(
        self,
        scene: Scene,
        rows: Sequence[int],
        width: int,
        budget: int,
        locate: Locate = here,
        *,
        device: str = "cpu",
        room: int = 0,
        threads: int = 1,
        mover: Mover | None = None,
    ) -> None:
        """Opens nothing yet.

        Args:
            width: pixels of the views, even and at most the scene's; their height is half of it.
            budget: bytes of decoded views to keep in the host's memory.
            locate: where the scene's files are; called by the threads that decode.
            device: where the views of `get` are, "cpu" or "cuda".
            room: bytes of decoded views that stay on a GPU, beyond those on their way (`passing_views`).
            threads: cores of the task, which a GPU's views are decoded on. On the CPU training needs them.

        Raises ConfigError: `width` is odd or more than the panoramas have.
        """
        self._panoramas = {row: scene.panoramas[row] for row in rows}
        if width < 2 or width % 2 or width > scene.width:
            raise ConfigError(f"width {width}: give an even number up to {scene.width}, the panoramas'")
        self._width = width
        self._locate = locate
        self._cpu = device == "cpu"
        self._mover = mover or (None if self._cpu else CudaMover(torch.device(device)))
        self.threads = _THREADS if self._cpu else max(1, min(threads, MOST_THREADS))
        self._staying: dict[int, _Loaded] = {}
        self._views: OrderedDict[int, _Loaded] = OrderedDict()  # the last is the most recently used
        self._decoded: OrderedDict[int, View] = OrderedDict()  # those that have left a GPU, likewise
        # One thread for each decode: OpenCV's own would fight with the trainer's for the cores.
        self._pool = ThreadPoolExecutor(self.threads, "decode", initializer=cv2.setNumThreads, initargs=(1,))
        sizes = [view_bytes(panorama, width) for panorama in self._panoramas.values()]
        largest = max(sizes, default=1)
        layered = any(panorama.files[1:] for panorama in self._panoramas.values())
        kept = int(budget * _LAYERS_SHARE) if layered and sum(sizes) > budget else 0
        self._layers, budget = DecodedLayers(kept, locate), budget - kept
        self._budget, self._room = max(1, budget // largest), 0 if self._cpu else room // largest  # views
        self._capacity = self._budget if self._cpu else passing_views(self.threads)
        _LOG.info(
            "image cache: holds %d panoramas of %d at width %d", self._budget, len(self._panoramas), width
        )
        if not self._cpu:
            _LOG.info("image cache: %d of them stay on the GPU, %d threads decode", self._room, self.threads)

    def ahead(self, least: int) -> int:
        """How many views to request before they are used: `least`, on a GPU enough for all threads."""
        return least if self._cpu else max(least, self.threads)

    def prefetch(self, rows: Iterable[int]) -> None:
        """Begins to decode the views that `get` will return next, in that order, as far as they fit."""
        for row in list(dict.fromkeys(rows))[: self._capacity]:
            self._request(row)

    def get(self, row: int) -> View:
        """The view of scene.panoramas[row]; waits until it is decoded, not until it is on a GPU.

        Raises SceneError: one of its files cannot be decoded; KeyError: `row` is not one of the cache's rows.
        """
        _, view, moving = self._request(row).result()
        if self._mover is not None and moving is not None:
            self._mover.end(moving)
        return view

    def close(self) -> None:
        """Drops all views and ends the threads."""
        self._pool.shutdown(cancel_futures=True)
        for loaded in (*self._staying.values(), *self._views.values()):
            loaded.cancel()
        for views in (self._staying, self._views, self._decoded):
            views.clear()

    def __enter__(self) -> "PanoramaCache":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _request(self, row: int) -> _Loaded:
        if row in self._staying:
            return self._staying[row]
        if row not in self._views:
            stays = len(self._staying) < self._room
            keep = not (stays or self._cpu)
            work = self._panoramas[row], row, self._width, self._decoded.pop(row, None), keep
            views = self._staying if stays else self._views
            views[row] = self._pool.submit(self._load, *work)
            if stays:
                return views[row]
        self._views.move_to_end(row)
        while len(self._views) > self._capacity:
            self._leave(*self._views.popitem(last=False))
        return self._views[row]

    def _load(
        self, panorama: Panorama, row: int, width: int, decoded: View | None, keep: bool
    ) -> tuple[View | None, View, Moving | None]:
        """Decodes a view, unless it is, and begins to move it to the device."""
        view = load_view(panorama, row, width, self._locate, self._layers) if decoded is None else decoded
        if self._mover is None:
            return None, view, None
        layers = view.layers()
        moving = self._mover.begin(layers, partial(pack, layers))
        return view if keep else None, View.of(row, moving.tensors), moving

    def _leave(self, row: int, loaded: _Loaded) -> None:
        """A view leaves the device: from a GPU its decoded form stays in the host's memory for a while."""
        if loaded.cancel() or not loaded.done() or loaded.exception() is not None:
            return
        if (view := loaded.result()[0]) is not None:
            self._decoded[row] = view
            while len(self._decoded) > self._budget:
                self._decoded.popitem(last=False)


def passing_views(threads: int) -> int:
    """How many views are on a GPU besides those that stay; as many as `threads` of them are pinned, too."""
    return min(threads, MOST_THREADS) + PASSING


def load_view(
    panorama: Panorama, row: int, width: int, locate: Locate = here, layers: DecodedLayers | None = None
) -> View:
    """Decodes one panorama and what belongs to it, found with `locate`, at (width / 2, width) pixels.

    Args: layers, which may have some already.
    Raises SceneError: one of its files cannot be decoded.
    """
    image, opaque = decode_with_alpha(locate(panorama.image), width)
    found = _load_layers(panorama, row, width, layers or DecodedLayers(locate=locate), opaque)
    return replace(found, image=torch.from_numpy(image))


def load_layers(panorama: Panorama, row: int, width: int) -> View:
    """Loads as `load_view`, but without the picture: `image` has no pixels."""
    opaque = decode_used(panorama.image) if panorama.transparent else None
    if opaque is not None:
        opaque = resize_used(opaque, (width, width // 2))
    return _load_layers(panorama, row, width, DecodedLayers(), opaque)


def _load_layers(
    panorama: Panorama, row: int, width: int, layers: DecodedLayers, used: NDArray[np.bool_] | None
) -> View:
    """`load_layers` of a panorama, of whose pixels (width / 2, width) some are used, or all of them."""
    size = (width, width // 2)
    sky = depth = None
    if panorama.mask:
        given = resize_used(layers.pixels(panorama.mask, decode_mask) > 0, size)
        used = given if used is None else given & used
    mask = None if used is None else torch.from_numpy(used)
    if panorama.sky_mask:
        foreground = _foreground(panorama.sky_mask, layers)
        sky = torch.from_numpy(resize(foreground, size) < WHITE)
    if panorama.depth:
        raw = layers.pixels(panorama.depth, _unchanged)
        depth = torch.from_numpy(_resize_depth(raw, size))
    if panorama.movers is not None:
        moving = cv2.resize(panorama.movers.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST) > 0
        still = torch.from_numpy(~moving)
        mask = still if mask is None else mask & still
    exposure = None if panorama.exposure is None else exposure_affine(torch.from_numpy(panorama.exposure))
    return View(row, torch.zeros((0, 0, 3), dtype=torch.uint8), mask, sky, depth, exposure)


def _foreground(path: Path, layers: DecodedLayers) -> NDArray[np.uint8]:
    """A sky mask, 255 or 1 = no sky. Raises ImageError for a map of classes, where all would be sky."""
    values = layers.pixels(path, _grey)
    most = int(values.max())
    if 1 < most < WHITE:
        raise ImageError(
            f"{path}: its largest value is {most}, so all of it would be sky: in a sky mask that is 0"
        )
    foreground: NDArray[np.uint8] = 255 * values if most == 1 else values
    return foreground


def _resize_depth(raw: NDArray[np.uint16], size: tuple[int, int]) -> NDArray[np.float32]:
    """Raw inverse depth to [0, 1] at `size`; 0 has no value, so only valid pixels enter a mean."""
    values = raw.astype(np.float32) / np.float32(65535)
    if size == (raw.shape[1], raw.shape[0]):
        return values
    weight = resize((raw > 0).astype(np.float32), size)
    total = resize(values, size)
    valid = weight >= 0.5  # at an edge the pixel goes to whichever has most of it
    depth: NDArray[np.float32] = np.divide(total, weight, out=np.zeros_like(total), where=valid)
    return depth


def exposure_affine(exposure: Tensor) -> Tensor:
    """(2, 3) float32 factors and summands of encoded colours, from `Panorama.exposure` (2, 3) float64.

    A gain g in linear light is a·(x + k) - k with a = g^(1/2.4) and k = 0.055 in sRGB above its linear part.
    """
    factor = torch.exp(exposure[0] / CURVE)
    return torch.stack([factor, TOE * (factor - 1) + exposure[1]]).float()


def exposed(picture: Tensor, exposure: Tensor | None) -> Tensor:
    """A rendered picture (..., 3) uint8 as a photograph of that exposure (2, 3), `View.exposure`, has it."""
    if exposure is None:
        return picture
    factor, summand = exposure.to(picture.device).unbind(0)
    return (picture * factor + 255 * summand).round().clamp(0, 255).to(torch.uint8)


def unexposed(colors: NDArray[np.float64], exposure: Tensor | None) -> NDArray[np.float64]:
    """Colours (..., 3) in [0, 1] of a photograph as a rendering has them; the inverse of `exposed`."""
    if exposure is None:
        return colors
    factor, summand = exposure.cpu().double().numpy()
    found: NDArray[np.float64] = ((colors - summand) / factor).clip(0, 1)
    return found


def view_bytes(panorama: Panorama, width: int) -> int:
    """Bytes of one decoded view: three of colour, one a mask, four of depth for each pixel."""
    bytes_per_pixel = 3 + panorama.masked + bool(panorama.sky_mask) + 4 * bool(panorama.depth)
    return bytes_per_pixel * width * (width // 2)
