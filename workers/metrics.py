"""Metrics of a rendered panorama against its photograph.

All metrics compare 8-bit images, as the field does: 3DGS saves its renders as PNG and evaluates those.
PSNR and SSIM weigh every pixel alike, as the paper's tables do; the WS variants weigh a pixel by the area
that it covers on the sphere. Masked pixels and the cropped bottom take no part in any of them.
"""

import importlib.util
import math
import pickle
import warnings
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from panolog.renderer import ops
from panolog.renderer.losses import ssim_map

_FIT, _RIDGE = 64, 1e-6  # pixels that a fit of colours needs; what holds it where they are of one colour
_LOWEST_MSE = 1e-10  # identical images get 100 dB: JSON has no infinity
_TILE = 512  # pixels of a side of what LPIPS computes at a time on a GPU
_STRIDE = 16  # pixels between two values of VGG16's coarsest layer that LPIPS uses, relu5_3
_SEEN = 7 * _STRIDE  # pixels that such a value sees around it, 98, up to where values begin
# Of a GPU for a tile: 5 · 122 floats for each of its (512 + 2 · 112)² pixels (the features of both images, as
# they are and normalised, and their differences), VGG16, and what a convolution needs.
LPIPS_BYTES = 1536 * 2**20

Image: TypeAlias = NDArray[Any] | Tensor

_WEIGHTS = "vgg16-397923af.pth"  # torchvision's VGG16, which LPIPS builds on


@dataclass(frozen=True, eq=False)
class Lpips:
    """LPIPS-VGG: Zhang et al., "The Unreasonable Effectiveness of Deep Features …", CVPR 2018.

    On a GPU by tiles: the features of a whole panorama of 4096 columns would need 20 GB.
    """

    network: Any  # lpips.LPIPS, untyped
    device: torch.device

    def __call__(self, render: Image, truth: Image, *, unit: bool = False) -> float:
        """The distance of two (H, W, 3) uint8 RGB images, 0 for equal ones.

        Args: unit, whether the network gets [0, 1], as from 3DGS, instead of the [-1, 1] it was trained for.
        """
        own = torch.get_num_threads()
        torch.set_num_threads(ops.threads())  # this network is all of torch's work in a worker
        try:
            with torch.no_grad():
                pair = self._scaled(render, unit), self._scaled(truth, unit)
                return float(self.network(*pair) if self.device.type == "cpu" else self.by_tiles(*pair))
        finally:
            torch.set_num_threads(own)

    def _scaled(self, image: Image, unit: bool) -> Tensor:
        tensor = torch.as_tensor(image).permute(2, 0, 1)[None].to(self.device, torch.float32)
        return tensor / 255 if unit else tensor / 127.5 - 1

    def by_tiles(self, a: Tensor, b: Tensor, side: int = _TILE) -> Tensor:
        """The network's distance () float64 of images (1, 3, H, W), equal to that of the whole within 1e-5.

        It is a sum of means, over one map of distances for each of the layers. Each tile is computed with
        what its features see around it, and its own part of the maps is added up.

        Args: side, pixels of a tile, a multiple of `_STRIDE`.
        """
        height, width = a.shape[2:]
        sums, counts = a.new_zeros(len(self.network.lins), dtype=torch.float64), [0] * len(self.network.lins)
        for rows in _spans(height, side):
            for columns in _spans(width, side):
                part = slice(None), slice(None), slice(*rows.seen), slice(*columns.seen)
                for layer, found in enumerate(self._layers(a[part], b[part])):
                    own = found[:, :, rows.own(2**layer), columns.own(2**layer)]
                    sums[layer] += own.sum(dtype=torch.float64)
                    counts[layer] += own.numel()
        return (sums / torch.tensor(counts).to(sums)).sum()

    def _layers(self, a: Tensor, b: Tensor) -> list[Tensor]:
        """The maps of distances (1, 1, h, w) whose means the network adds, from the finest layer on."""
        maps: list[Tensor] = []
        hooks = [
            lin.register_forward_hook(lambda _module, _given, found: maps.append(found))
            for lin in self.network.lins
        ]
        try:
            self.network(a, b)
        finally:
            for hook in hooks:
                hook.remove()
        return maps


@dataclass(frozen=True)
class _Span:
    """The rows or columns of one tile."""

    first: int  # pixel
    last: int | None  # pixel after it, None = the image ends
    seen: tuple[int, int]  # with what its features see

    def own(self, stride: int) -> slice:
        """The span's own part of a map with `stride` pixels to a value."""
        begin = (self.first - self.seen[0]) // stride
        return slice(begin, None if self.last is None else (self.last - self.seen[0]) // stride)


def _spans(size: int, side: int) -> list[_Span]:
    """Tiles along one axis. All but the last end where no feature straddles."""
    return [
        _Span(
            first,
            first + side if first + side < size else None,
            (max(0, first - _SEEN), min(size, first + side + _SEEN)),
        )
        for first in range(0, size, side)
    ]


@dataclass(frozen=True, eq=False)
class Pair:
    """A render and its ground truth, cut to the rows and blackened outside the pixels that count."""

    render: Tensor  # (h, W, 3) uint8
    truth: Tensor  # (h, W, 3) uint8
    valid: Tensor  # (h, W) bool
    area: NDArray[np.float64]  # (h,) share of the sphere of a pixel in each row, up to a factor


def measure(
    render: Image,
    truth: Image,
    mask: Image | None = None,
    *,
    crop_bottom: float = 0.0,
    lpips: Lpips | None = None,
) -> dict[str, float | None]:
    """PSNR and WS-PSNR in dB, SSIM and WS-SSIM, LPIPS; None if no pixel counts, LPIPS also without `lpips`.

    The same with the prefix `cc_` after `color_fit`: these do not count differences of exposure.

    LPIPS twice: as its authors define it, and as `lpips_3dgs` of images in [0, 1], which tables of papers
    that evaluate with the code of 3DGS have. These values are lower.

    Computed where the images are; only sums over rows leave that device. Squared errors are integers, so PSNR
    is the same on every device; SSIM may differ by 1e-5, by 1e-4 for images without texture.

    Args: render and truth (ground truth), (H, W, 3) uint8 RGB; mask (H, W) bool, True = counts; crop_bottom,
    fraction of the height, of which at least a row stays.
    Raises ValueError if shapes disagree or `crop_bottom` is not in [0, 1).
    """
    pair = _pair(render, truth, mask, crop_bottom)
    fitted = replace(pair, render=color_fit(pair))
    plain, corrected = torch.stack([_row_sums(pair), _row_sums(fitted)]).cpu().numpy()
    found = _means(pair, plain) | _lpips(pair, lpips, {"lpips": False, "lpips_3dgs": True})
    again = _means(fitted, corrected) | _lpips(fitted, lpips, {"lpips": False})
    return found | {f"cc_{name}": value for name, value in again.items()}


def _means(pair: Pair, sums: NDArray[np.float64]) -> dict[str, float | None]:
    """Args: sums (3, h), `_row_sums`."""
    errors, similarity, counts = sums
    if not counts.any():
        return dict.fromkeys(("psnr", "ssim", "ws_psnr", "ws_ssim"))
    uniform = np.ones(len(counts))

    def mean(sums: NDArray[np.float64], area: NDArray[np.float64]) -> float:
        return float((sums * area).sum() / (counts * area).sum())

    return {
        "psnr": decibel(mean(errors, uniform)),
        "ssim": mean(similarity, uniform),
        "ws_psnr": decibel(mean(errors, pair.area)),
        "ws_ssim": mean(similarity, pair.area),
    }


def _lpips(pair: Pair, lpips: Lpips | None, scales: dict[str, bool]) -> dict[str, float | None]:
    """Args: scales, whether images are in [0, 1], by name."""
    if lpips is None or not bool(pair.valid.any()):
        return dict.fromkeys(scales)
    return {name: lpips(pair.render, pair.truth, unit=unit) for name, unit in scales.items()}


def color_fit(pair: Pair) -> Tensor:
    """(h, W, 3) uint8: the render with the affine map of its colours that fits the ground truth best.

    Least squares over the pixels that count and are not clipped in either image, by which the field compares
    views whose exposure a model cannot know ("color-corrected", Martin-Brualla et al., CVPR 2021; Barron et
    al., CVPR 2022). Sums are of integers, so it is the same on every device.
    """
    used = pair.valid.clone()
    for image in (pair.render, pair.truth):
        used &= ((image > 0) & (image < 255)).all(2)
    colors = torch.cat([pair.render.double(), used[..., None].double()], dim=2).flatten(0, 1)
    known = colors * used.flatten()[:, None]
    normal, right = known.T @ known, known.T @ pair.truth.double().flatten(0, 1)
    pixels = normal[3, 3].clone()
    hold = _RIDGE * (pixels + 1) * torch.eye(4, dtype=torch.float64, device=used.device)
    fit = torch.linalg.solve(normal + hold, right + hold[:, :3])  # held towards no change
    fit = torch.where(pixels < _FIT, torch.eye(4, 3, dtype=fit.dtype, device=fit.device), fit)
    mapped = pair.render.double() @ fit[:3] + fit[3]
    fitted: Tensor = mapped.round().clamp(0, 255).to(torch.uint8) * pair.valid[..., None]
    return fitted


def _row_sums(pair: Pair) -> Tensor:
    """(3, h) sums over the pixels of each row that count: squared errors of [0, 1], SSIM, their number."""
    squared = (pair.render.to(torch.int32) - pair.truth).square_().sum((1, 2)).double() / (3 * 255**2)
    similarity = (ssim_map(_unit(pair.render), _unit(pair.truth)) * pair.valid).sum(1, dtype=torch.float64)
    return torch.stack([squared, similarity, pair.valid.sum(1).double()])


def sphere_weights(height: int) -> NDArray[np.float64]:
    """(H,) area of a pixel in each row of a panorama, relative to the equator: the cosine of its latitude.

    Source: Sun, Lu, Yu, "Weighted-to-Spherically-Uniform Quality Evaluation for Omnidirectional Video", IEEE
    Signal Processing Letters 2017 (WS-PSNR); Zhou et al., "Weighted-to-Spherically-Uniform SSIM Objective
    Quality Evaluation for Panoramic Video", ICSP 2018 (WS-SSIM).
    """
    weights: NDArray[np.float64] = np.cos((np.arange(height) + 0.5 - height / 2) * np.pi / height)
    return weights


def _pair(render: Image, truth: Image, mask: Image | None, crop_bottom: float) -> Pair:
    """The two images in the state in which they are compared.

    What is masked becomes black in both: windows and features that reach over its edge find no difference.
    """
    render, truth = torch.as_tensor(render), torch.as_tensor(truth)
    valid = torch.ones_like(truth[..., 0], dtype=torch.bool) if mask is None else torch.as_tensor(mask)
    if render.shape != truth.shape or valid.shape != truth.shape[:2]:
        raise ValueError(
            f"render {tuple(render.shape)}, ground truth {tuple(truth.shape)} and mask must have one size"
        )
    if not 0 <= crop_bottom < 1:
        raise ValueError(f"the cropped fraction is {crop_bottom}, must be at least 0 and below 1")
    height = max(1, truth.shape[0] - round(crop_bottom * truth.shape[0]))
    area, black = sphere_weights(truth.shape[0]), valid[:height, :, None]
    return Pair(render[:height] * black, truth[:height] * black, valid[:height], area[:height])


def _unit(image: Tensor) -> Tensor:
    return image.to(torch.float32) / 255


def decibel(mse: float) -> float:
    """The PSNR of a mean squared error of colours in [0, 1], 100 dB at most."""
    return -10 * math.log10(max(mse, _LOWEST_MSE))


def load_lpips(device: str) -> tuple[Lpips | None, str | None]:
    """LPIPS on a device, or None and in one line why it is not available. Nothing is downloaded."""
    for package in ("lpips", "torchvision"):
        if importlib.util.find_spec(package) is None:
            return None, f"LPIPS needs the package {package}: pip install {package}"
    weights = Path(torch.hub.get_dir()) / "checkpoints" / _WEIGHTS
    if not weights.is_file():
        return None, f"LPIPS needs VGG16 weights at {weights}: https://download.pytorch.org/models/{_WEIGHTS}"
    try:
        import lpips  # noqa: PLC0415  # optional; its torchvision may be built for another torch

        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # torchvision's deprecations of what lpips calls
            network = lpips.LPIPS(net="vgg", verbose=False)
    except (ImportError, OSError, EOFError, RuntimeError, pickle.UnpicklingError) as error:
        first_line = (str(error) or type(error).__name__).splitlines()[0]
        return None, f"LPIPS cannot be loaded with {weights}: {first_line}"
    return Lpips(network.to(device).eval(), torch.device(device)), None
