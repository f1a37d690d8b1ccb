"""Metrics of a rendered panorama against its photograph.

All metrics compare 8-bit images, as the field does: 3DGS saves its renders as PNG and evaluates those.
PSNR and SSIM weigh every pixel alike, as the paper's tables do; the WS variants weigh a pixel by the area
that it covers on the sphere. Masked pixels and the cropped bottom take no part in any of them.
"""

import importlib.util
import math
import pickle
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from panolog.renderer import ops
from panolog.renderer.losses import ssim_map

_LOWEST_MSE = 1e-10  # identical images get 100 dB: JSON has no infinity
_WEIGHTS = "vgg16-397923af.pth"  # torchvision's VGG16, which LPIPS builds on


@dataclass(frozen=True, eq=False)
class Lpips:
    """LPIPS-VGG: Zhang et al., "The Unreasonable Effectiveness of Deep Features …", CVPR 2018."""

    network: Any  # lpips.LPIPS, untyped
    device: torch.device

    def __call__(self, render: NDArray[np.uint8], truth: NDArray[np.uint8]) -> float:
        """The distance of two (H, W, 3) RGB images, 0 for equal ones."""
        own = torch.get_num_threads()
        torch.set_num_threads(ops.threads())  # this network is all of torch's work in a worker
        try:
            with torch.no_grad():
                return float(self.network(self._scaled(render), self._scaled(truth)))
        finally:
            torch.set_num_threads(own)

    def _scaled(self, image: NDArray[np.uint8]) -> torch.Tensor:
        # LPIPS expects [-1, 1]; 3DGS passes [0, 1] to its own copy, so its values are slightly lower
        tensor = torch.from_numpy(image).permute(2, 0, 1)[None].to(self.device, torch.float32)
        return tensor / 127.5 - 1


@dataclass(frozen=True, eq=False)
class Pair:
    """A render and its ground truth, cut to the rows and blackened outside the pixels that count."""

    render: NDArray[np.uint8]  # (h, W, 3)
    truth: NDArray[np.uint8]  # (h, W, 3)
    valid: NDArray[np.bool_]  # (h, W)
    area: NDArray[np.float64]  # (h, W) share of the sphere, up to a factor; 0 where not valid


def measure(
    render: NDArray[np.uint8],
    truth: NDArray[np.uint8],
    mask: NDArray[np.bool_] | None = None,
    *,
    crop_bottom: float = 0.0,
    lpips: Lpips | None = None,
) -> dict[str, float | None]:
    """PSNR and WS-PSNR in dB, SSIM and WS-SSIM, LPIPS; None if no pixel counts, LPIPS also without `lpips`.

    Args: render and truth (ground truth), (H, W, 3) RGB; mask (H, W), True = counts; crop_bottom, fraction of
    the height.
    Raises ValueError if shapes disagree or `crop_bottom` is not in [0, 1).
    """
    pair = _pair(render, truth, mask, crop_bottom)
    if not pair.valid.any():
        return dict.fromkeys(("psnr", "ssim", "ws_psnr", "ws_ssim", "lpips"))
    squared = ((pair.render.astype(np.float64) - pair.truth) ** 2).mean(axis=2) / 255**2
    similarity = ssim_map(_unit(pair.render), _unit(pair.truth)).numpy().astype(np.float64)
    return {
        "psnr": _decibel(np.average(squared, weights=pair.valid)),
        "ssim": float(np.average(similarity, weights=pair.valid)),
        "ws_psnr": _decibel(np.average(squared, weights=pair.area)),
        "ws_ssim": float(np.average(similarity, weights=pair.area)),
        "lpips": lpips(pair.render, pair.truth) if lpips else None,
    }


def sphere_weights(height: int) -> NDArray[np.float64]:
    """(H,) area of a pixel in each row of a panorama, relative to the equator: the cosine of its latitude.

    Source: Sun, Lu, Yu, "Weighted-to-Spherically-Uniform Quality Evaluation for Omnidirectional Video", IEEE
    Signal Processing Letters 2017 (WS-PSNR); Zhou et al., "Weighted-to-Spherically-Uniform SSIM Objective
    Quality Evaluation for Panoramic Video", ICSP 2018 (WS-SSIM).
    """
    weights: NDArray[np.float64] = np.cos((np.arange(height) + 0.5 - height / 2) * np.pi / height)
    return weights


def _pair(
    render: NDArray[np.uint8], truth: NDArray[np.uint8], mask: NDArray[np.bool_] | None, crop_bottom: float
) -> Pair:
    """Both images in the state in which they are compared.

    What is masked becomes black in both: windows and features that reach over its edge find no difference.
    """
    if render.shape != truth.shape or (mask is not None and mask.shape != truth.shape[:2]):
        raise ValueError(f"render {render.shape}, ground truth {truth.shape} and mask must have one size")
    if not 0 <= crop_bottom < 1:
        raise ValueError(f"the cropped fraction is {crop_bottom}, must be at least 0 and below 1")
    height = truth.shape[0] - round(crop_bottom * truth.shape[0])
    valid = np.ones(truth.shape[:2], bool) if mask is None else mask
    area = sphere_weights(truth.shape[0])[:, None] * valid
    black = valid[:height, :, None]
    return Pair(render[:height] * black, truth[:height] * black, valid[:height], area[:height])


def _unit(image: NDArray[np.uint8]) -> torch.Tensor:
    return torch.from_numpy(image.astype(np.float32) / 255)


def _decibel(mse: float) -> float:
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
