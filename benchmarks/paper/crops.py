"""Where variants differ most: crops of held-out panoramas with the truth, each variant and its error."""

from base64 import b64encode
from collections.abc import Mapping
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from benchmarks.paper.measure import Gallery, Picture
from panolog.renderer.render import encode_png
from panolog.scene.gaussians import Gaussians

_SIDE = 8  # a crop is so many times narrower than the panorama
_COUNT = 3  # crops of a scene
_BRIGHT = 3.0  # times the error that is shown

Errors = NDArray[np.float32]  # (V, H, W) mean absolute error of the channels, 0 to 255


@dataclass(frozen=True)
class Window:
    """A square of a held-out panorama."""

    row: int  # of scene.panoramas
    top: int  # pixels
    left: int
    side: int


@dataclass(frozen=True)
class Crop:
    """One picture for the page."""

    label: str
    image: str  # data URI of a PNG
    error: str  # the same of its error, empty for the truth


@dataclass(frozen=True)
class Comparison:
    """A window as all see it."""

    scene: str
    view: str
    crops: tuple[Crop, ...]


def compare(scene: str, gallery: Gallery, models: Mapping[str, Gaussians]) -> list[Comparison]:
    """The windows in which the models differ most, the truth first. Empty for fewer than two models."""
    if len(models) < 2 or not gallery.rows:
        return []
    side = max(8, gallery.width // _SIDE)
    candidates: list[tuple[float, Window]] = []
    for row in gallery.rows:
        candidates += [
            (value, Window(row, top, left, side)) for value, top, left in _windows(gallery, models, row, side)
        ]
    chosen = [window for _, window in sorted(candidates, key=lambda found: -found[0])[:_COUNT]]
    return [_comparison(scene, gallery, models, window) for window in chosen]


def _windows(
    gallery: Gallery, models: Mapping[str, Gaussians], row: int, side: int
) -> list[tuple[float, int, int]]:
    """(how much the models differ, top, left) of windows of a panorama that do not overlap, best first."""
    view = gallery.truth(row)
    truth = view.image.cpu().numpy()
    renders = [gallery.render(model, row) for model in models.values()]
    errors = np.stack([_error(render, truth) for render in renders])
    if view.mask is not None:
        errors *= view.mask.cpu().numpy()
    height = truth.shape[0] - round(gallery.crop_bottom * truth.shape[0])
    return best_windows(errors[:, :height], side, _COUNT)


def best_windows(errors: Errors, side: int, count: int) -> list[tuple[float, int, int]]:
    """Up to `count` windows (difference, top, left) with the largest range of mean errors, without overlap.

    Args: errors (V, H, W) of V variants; side in pixels.
    """
    side = min(side, errors.shape[1], errors.shape[2])
    means = np.stack([_box(error, side) for error in errors])
    differing = means.max(axis=0) - means.min(axis=0)
    found = []
    for _ in range(count):
        top, left = np.unravel_index(int(differing.argmax()), differing.shape)
        value = float(differing[top, left])
        if value <= 0:
            break
        found.append((value, int(top), int(left)))
        differing[max(0, top - side + 1) : top + side, max(0, left - side + 1) : left + side] = 0
    return found


def _box(error: Errors, side: int) -> Errors:
    """(H - side + 1, W - side + 1) means over squares, by a summed-area table."""
    sums = cv2.integral(error)
    total = sums[side:, side:] - sums[:-side, side:] - sums[side:, :-side] + sums[:-side, :-side]
    return np.asarray(total / side**2, np.float32)


def _error(render: Picture, truth: Picture) -> Errors:
    difference = np.abs(render.astype(np.int16) - truth).mean(axis=2)
    return np.asarray(difference, np.float32)


def _comparison(scene: str, gallery: Gallery, models: Mapping[str, Gaussians], window: Window) -> Comparison:
    truth = gallery.truth(window.row).image.cpu().numpy()
    rows = slice(window.top, window.top + window.side)
    columns = slice(window.left, window.left + window.side)
    crops = [Crop("truth", _uri(truth[rows, columns]), "")]
    for name, model in models.items():
        render = gallery.render(model, window.row)
        grey = np.clip(_BRIGHT * _error(render, truth)[rows, columns], 0, 255).astype(np.uint8)
        crops.append(Crop(name, _uri(render[rows, columns]), _uri(np.repeat(grey[..., None], 3, axis=2))))
    return Comparison(scene, gallery.scene.panoramas[window.row].name, tuple(crops))


def _uri(image: Picture) -> str:
    return f"data:image/png;base64,{b64encode(encode_png(np.ascontiguousarray(image))).decode()}"
