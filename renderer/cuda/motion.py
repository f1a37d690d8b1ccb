"""The sums of camera motion on CUDA (`renderer.motion`)."""

import math

import torch
from torch import Tensor

from panolog.renderer.cuda.parts import SPAN, Launch
from panolog.renderer.motion import MOTION, MOTION_SUMS

MOTION_SPAN = 4096  # kMotionSpan in csrc/cuda/project.cu


def room_for(means: Tensor, moving: bool) -> Tensor | None:
    """(N, 6) to receive the parts of N Gaussians in the gradient of a pose; None if cameras stay."""
    return means.new_empty(len(means), MOTION) if moving else None


def motion_sums(launch: Launch, motion: Tensor) -> Tensor:
    """(27,) float64 sums of the parts (N, 6) that Gaussians have, their order fixed."""
    count = len(motion)
    blocks = math.ceil(count / MOTION_SPAN)
    sums = motion.new_empty(blocks, MOTION_SUMS, dtype=torch.float64)
    launch("project_motion", (blocks, 1), SPAN, motion=motion, count=count, sums=sums)
    return sums.sum(0)


def with_motion(launch: Launch, report: Tensor, motion: Tensor | None) -> Tensor:
    """A report, and the sums of motion after it where there are any."""
    return report if motion is None else torch.cat([report, motion_sums(launch, motion)])
