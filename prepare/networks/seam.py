"""Panoramas for networks that are not made for them.

The estimates of a network for flat images differ at the left and the right border: a step of depth where the
panorama has none. So the surroundings of the border are estimated a second time from pixels on both sides of
it, and the two estimates are blended.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager

import numpy as np
from numpy.typing import NDArray

from panolog.prepare.networks.manifest import Input
from panolog.scene.errors import ConfigError

Floats = NDArray[np.float32]
MatchScale = Callable[[Floats, Floats], Floats]


def network_images(image: NDArray[np.uint8], given: Input) -> NDArray[np.uint8]:
    """(K, height, width, 3) the images that the network gets of a panorama (h, 2h, 3), one or two.

    With seam "turn" the second is turned by 180 degrees; with "wrap" the one is continued beyond its borders.
    """
    if given.seam == "turn":
        return np.stack([image, np.roll(image, given.height, axis=1)])
    if given.seam == "wrap":
        return np.pad(image, ((0, 0), (given.wrap, given.wrap), (0, 0)), mode="wrap")[None]
    return image[None]


def blend(estimates: Floats, given: Input, fit: MatchScale | None = None) -> Floats:
    """One panorama (h, 2h) of the estimates for the images that `network_images` made.

    Args: estimates (K, h, w), NaN where there is none: the other estimate is taken there, and where both are
    NaN the result is; fit(second, first), the second brought to the scale of the first, for estimates that
    are relative. Raises ValueError if w is not h times the input's aspect.
    """
    height, width = estimates.shape[1:]
    if width * given.height != height * given.width or (given.wrap * height) % given.height:
        raise ValueError(
            f"{height} x {width} is not a scaled {given.height} x {given.width}; the manifest's input does "
            "not fit it"
        )
    if given.seam == "turn":
        second = np.roll(estimates[1], -height, axis=1)
        ramp = np.abs(np.arange(width, dtype=np.float32) + np.float32(0.5) - height) / np.float32(height)
        return _mix(estimates[0], fit(second, estimates[0]) if fit else second, ramp)
    if given.seam == "wrap":
        return _folded(estimates[0], given.wrap * height // given.height)
    only: Floats = estimates[0]
    return only


def _folded(estimate: Floats, wrap: int) -> Floats:
    """(h, w - 2 wrap): both ends of (h, w) show the same 2 wrap columns, and pass into each other there."""
    inner = estimate[:, wrap:-wrap].copy()
    ramp = (np.arange(2 * wrap, dtype=np.float32) + np.float32(0.5)) / np.float32(2 * wrap)
    mixed = _mix(estimate[:, -2 * wrap :], estimate[:, : 2 * wrap], ramp)
    inner[:, -wrap:], inner[:, :wrap] = mixed[:, :wrap], mixed[:, wrap:]
    return inner


def _mix(first: Floats, second: Floats, share: Floats) -> Floats:
    """first (h, w) where the `share` (w,) of second is 0, second where it is 1; a number beats NaN."""
    mixed = first * (1 - share) + second * share
    found: Floats = np.where(np.isnan(first), second, np.where(np.isnan(second), first, mixed))
    return found


@contextmanager
def named(output: str) -> Iterator[None]:
    """Within the context, a ValueError becomes a ConfigError that names an output."""
    try:
        yield
    except ValueError as error:
        raise ConfigError(f"{output}: {error}") from error


def plane(output: Floats) -> Floats:
    """(K, h, w) of an output with one channel, on axis 1 or 3. Raises ValueError if it has more."""
    if output.ndim == 4:
        axis = 1 if output.shape[1] == 1 else 3
        if output.shape[axis] == 1:
            output = output.squeeze(axis)
    if output.ndim != 3:
        raise ValueError(f"{output.shape} is not one channel for each image")
    return output
