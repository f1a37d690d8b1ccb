"""LPIPS with VGG features, where its package and weights are installed; nothing is ever downloaded."""

import importlib.util
import pickle
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

_WEIGHTS = "vgg16-397923af.pth"  # torchvision's VGG16, which LPIPS builds on


@dataclass(frozen=True, eq=False)
class Lpips:
    """LPIPS-VGG: Zhang et al., "The Unreasonable Effectiveness of Deep Features …", CVPR 2018."""

    network: Any  # lpips.LPIPS, untyped
    device: torch.device

    def __call__(self, render: NDArray[np.uint8], truth: NDArray[np.uint8]) -> float:
        """The distance of two (H, W, 3) RGB images, 0 for equal ones."""
        with torch.no_grad():
            return float(self.network(self._scaled(render), self._scaled(truth)))

    def _scaled(self, image: NDArray[np.uint8]) -> torch.Tensor:
        # LPIPS asks for [-1, 1]; 3DGS feeds its own copy [0, 1], so its numbers are a little lower.
        tensor = torch.from_numpy(image).permute(2, 0, 1)[None].to(self.device, torch.float32)
        return tensor / 127.5 - 1


def load_lpips(device: str) -> tuple[Lpips | None, str | None]:
    """LPIPS on a device, or None and the reason, in one line, why it cannot be had."""
    for package in ("lpips", "torchvision"):
        if importlib.util.find_spec(package) is None:
            return None, f"LPIPS needs the package {package}: pip install 'panolog[lpips]'"
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
