"""A picture of the run in progress: the render above the truth."""

import cv2
import numpy as np
import torch
from torch import Tensor

MAX_WIDTH = 1024  # pixels
QUALITY = 85  # of the JPEG


def jpeg(color: Tensor, truth: Tensor) -> bytes:
    """A JPEG of the render (H, W, 3) float in [0, 1], clamped, above the truth (H, W, 3) uint8, both RGB."""
    render = (color.detach().clamp(0, 1) * 255).round().to(torch.uint8).cpu().numpy()
    both = np.concatenate([render, truth.cpu().numpy()])
    if both.shape[1] > MAX_WIDTH:
        height = both.shape[0] * MAX_WIDTH // both.shape[1]
        both = cv2.resize(both, (MAX_WIDTH, height), interpolation=cv2.INTER_AREA)
    _, data = cv2.imencode(".jpg", both[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, QUALITY])
    return data.tobytes()
