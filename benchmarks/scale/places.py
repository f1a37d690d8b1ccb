"""Cities as scenes in memory: the streets of `panolog demo --city`, without images."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from panolog.scene.model import Panorama, Scene
from panolog.scene.read import HOLD_OUT
from panolog.synthetic.city import drive, plan
from panolog.synthetic.make import DENSITY

_NEAR, _FAR = 6.0, 60.0  # metres from a panorama to the points that it has seen: houses begin, the cloud ends
_HIGH = 15.0  # metres
_ROOT = Path("city")


def city(panoramas: int, width: int, seed: int = 0) -> Scene:
    """A city as large as so many panoramas on a drive along all of its streets take; its files do not exist.

    Points are drawn around the panoramas instead of cast, as many as a city that is written has, nearer ones
    more often: uniform in the logarithm of the distance. Each is known to one panorama.
    """
    rotations, centers = drive(plan(panoramas), panoramas, seed)
    random = np.random.default_rng([seed, panoramas])
    count = DENSITY * panoramas
    angle = random.uniform(0, 2 * np.pi, count)
    distance = _NEAR * (_FAR / _NEAR) ** random.uniform(0, 1, count)
    around = np.stack(
        [distance * np.cos(angle), distance * np.sin(angle), random.uniform(-2, _HIGH, count)], 1
    )
    rows = np.arange(count).reshape(panoramas, DENSITY)
    return Scene(
        root=_ROOT,
        width=width,
        height=width // 2,
        panoramas=tuple(
            _panorama(i, turn, -turn @ center, observed)
            for i, (turn, center, observed) in enumerate(zip(rotations, centers, rows, strict=True))
        ),
        points=np.repeat(centers, DENSITY, axis=0) + around,
        colors=np.full((count, 3), 128, np.uint8),
        train=tuple(i for i in range(panoramas) if i % HOLD_OUT),
        test=tuple(range(0, panoramas, HOLD_OUT)),
        fingerprint="",
    )


def _panorama(
    index: int, rotation: NDArray[np.float64], translation: NDArray[np.float64], observed: NDArray[np.int64]
) -> Panorama:
    """With the layers of a synthetic scene."""
    file = _ROOT / f"{index:06d}.png"
    return Panorama(file.name, file, rotation, translation, observed, sky_mask=file, depth=file)
