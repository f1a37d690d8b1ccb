"""The sums of a camera's motion on CUDA, see `renderer.motion`: for iterations that learn poses."""

import math

import torch
from torch import Tensor

from panolog.renderer.cuda.parts import SPAN, Launch
from panolog.renderer.motion import MOTION_SUMS

_MOTION_SPAN = 4096  # kMotionSpan in csrc/cuda/project.cu


def motion_sums(launch: Launch, motion: Tensor) -> Tensor:
    """(27,) float64 sums as in `renderer.motion`, of the parts (N, 6) that Gaussians have."""
    count = len(motion)
    blocks = math.ceil(count / _MOTION_SPAN)
    sums = motion.new_empty(blocks, MOTION_SUMS, dtype=torch.float64)
    launch("project_motion", (blocks, 1), SPAN, motion=motion, count=count, sums=sums)
    return sums.sum(0)
