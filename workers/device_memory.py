"""Bytes of a GPU that a task needs, by counting the tensors that live at once in its largest moments.

A test (tests/workers/test_device_memory.py) runs the same code on tensors without memory and compares;
docs/design.md has the terms. The need is that of the largest moment. A densification holds the old and the
new parameters or moments of one kind at a time, without gradients: less than an iteration.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

from panolog.workers.training.iterations import AHEAD, MARGIN

VALUES = 59 * 4  # bytes of one Gaussian's parameters
# What torch.cuda.max_memory_allocated leaves out: the CUDA context of the process (its stacks, the code of
# torch's and our kernels). An assumption, until a card has shown it: nvidia-smi lists it for a process.
CONTEXT = 512 * 2**20

# Pairs of splats and tiles: so many for each Gaussian, and so many for each pixel, whichever splats cover it.
# Measured: 1.8 for each of 10 M random ones at 4096 x 2048 (here 2.3); of the demo's 105,688 trained ones 3.5
# at 1024 x 512 (here 4.0), 8 at 2048 x 1024 (10), 23 at 4096 x 2048 (34).
_PAIRS, _PAIRS_OF_PIXEL = 2.0, 0.4

_STATE = 3 * VALUES + 8 + 8  # parameters, moments, statistics, units of two rates
_SPLAT = 64 + 64 + 4  # and its rays, and the number of its tiles
_IMAGES = 12 + 4 + 4  # colour, alpha, inverse depth
_VIEW = 3 + 1 + 1 + 4  # a panorama with its layers
_TARGET = 4 + 1  # its aligned depth, and where that is valid


@dataclass(frozen=True)
class _Moment:
    """What lives at once, in bytes."""

    gaussian: float
    pixel: float
    pair: float

    @property
    def of_gaussian(self) -> float:
        """With its pairs."""
        return self.gaussian + _PAIRS * self.pair

    @property
    def of_pixel(self) -> float:
        return self.pixel + _PAIRS_OF_PIXEL * self.pair


def _sorting(held: int, view: int) -> _Moment:
    """While pairs are sorted by tiles, in int16. Args: `held` of a Gaussian, `view` of a pixel."""
    pairs = 2 + 4 + (2 + 8) + (8 + 10)  # tiles, rows; sorted tiles, and as what; torch.sort's own
    return _Moment(held + _SPLAT + 1 + 4 + 8 + 8, view, pairs)  # state, depth; rows by depth, ends of pairs


def _iteration(
    held: int, view: int, kept: int, gradients: int, room: float = 1.0
) -> tuple[_Moment, _Moment, _Moment]:
    """The largest moments of a pass forward and backward: its binning, its loss and its end.

    Args: `kept` of a Gaussian after the binning besides its splat; `gradients` of its parameters at the end;
    `room` for pairs, over how many there are.
    """
    visible, sorting = held + _SPLAT + kept, _sorting(held, view)
    loss = _Moment(visible, view + _IMAGES + 3 * 12 + 12, 4 * room)
    end = _Moment(visible + 52 + gradients + 8, view + 2 * _IMAGES, 4 * room)
    return replace(sorting, pair=sorting.pair * room), loss, end


# kept: state, depth, ends of pairs; the views of all iterations that are launched
_TRAINING = _iteration(_STATE + 8, AHEAD * (_VIEW + _TARGET), kept=1 + 4 + 8, gradients=0, room=MARGIN)
_SCORING = _iteration(VALUES + 8, _VIEW, kept=2, gradients=VALUES)  # visible, invalid
_RENDERING = (_sorting(VALUES + 8, _VIEW), _Moment(VALUES, _VIEW + 3 * 12, 0))  # at last colours as bytes


def training(gaussians: int, pixels: int) -> int:
    """Peak bytes, without `CONTEXT`, of a task that trains so many Gaussians on panoramas of `pixels`."""
    return _peak(_TRAINING, gaussians, pixels)


def scoring(gaussians: int, pixels: int) -> int:
    """The bytes on a GPU of a task that scores cameras."""
    return _peak(_SCORING, gaussians, pixels)


def rendering(gaussians: int, pixels: int) -> int:
    """The bytes on a GPU of a task that only renders, such as an evaluation."""
    return _peak(_RENDERING, gaussians, pixels)


def trainable(memory: int, pixels: int) -> int:
    """The most Gaussians for which `training` is within so many bytes."""
    return max(0, int(min((memory - at.of_pixel * pixels) / at.of_gaussian for at in _TRAINING)))


def pairs(gaussians: int, pixels: int) -> int:
    """Pairs of splats and tiles that are assumed."""
    return int(_PAIRS * gaussians + _PAIRS_OF_PIXEL * pixels)


def _peak(moments: Sequence[_Moment], gaussians: int, pixels: int) -> int:
    return int(max(at.of_gaussian * gaussians + at.of_pixel * pixels for at in moments))
