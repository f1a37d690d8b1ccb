"""Panoramas for networks that do not know that they are round.

A network that is shown a flat picture says something else left of its border than right of it: a step of
depth where the panorama has none. So what is near the border is estimated a second time from pixels that
surround it, and the two estimates pass into each other.
"""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from panolog.prepare.networks.manifest import Input

Floats = NDArray[np.float32]
MatchScale = Callable[[Floats, Floats], Floats]


def network_images(image: NDArray[np.uint8], given: Input) -> NDArray[np.uint8]:
    """What the network is shown of a panorama (h, 2h, 3): (K, height, width, 3), one picture or two.

    With seam "turn" the second is turned by 180 degrees; with "wrap" the one goes on beyond its borders.
    """
    if given.seam == "turn":
        return np.stack([image, np.roll(image, given.height, axis=1)])
    if given.seam == "wrap":
        return np.pad(image, ((0, 0), (given.wrap, given.wrap), (0, 0)), mode="wrap")[None]
    return image[None]


def blend(estimates: Floats, given: Input, fit: MatchScale | None = None) -> Floats:
    """One panorama (h, 2h) of what a network said of the pictures that `network_images` made.

    Args: estimates (K, h, w), NaN where the network says nothing: the other estimate is taken there, and
    where both say nothing the result is NaN; fit(second, first), the second brought to the scale of the
    first, for estimates that are relative. Raises ValueError if w is not h times the input's aspect.
    """
    height, width = estimates.shape[1:]
    if width * given.height != height * given.width or (given.wrap * height) % given.height:
        raise ValueError(f"{height} x {width} is no scaled {given.height} x {given.width}")
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
