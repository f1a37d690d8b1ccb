"""How somebody walks through the town with a panoramic camera: poses along the street at head height."""

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

STEP, LONGEST = 1.5, 56.0  # metres between panoramas, and of the whole walk

# Camera x right, y down, z forward, with forward along the world's x and down against its z.
AHEAD = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])


def walk(count: int, seed: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """World-to-camera rotations (count, 3, 3) and camera centres (count, 3) in metres.

    Nobody walks straight: the path meanders, steps differ, and the camera turns and tilts a little.
    """
    random = np.random.default_rng([seed, 2])
    length = min(STEP * (count - 1), LONGEST)
    x = np.linspace(-length / 2, length / 2, count) + random.uniform(-0.3, 0.3, count) * length / count
    y = 0.6 * np.sin(x / 6.0) + random.uniform(-0.25, 0.25, count)
    z = 1.65 + random.uniform(-0.04, 0.04, count)
    yaw = 10 * np.cos(x / 6.0) + random.uniform(-6, 6, count)
    tilt, roll = random.uniform(-1.5, 1.5, (2, count))
    turned = Rotation.from_euler(
        "ZYX", np.stack([yaw, tilt, roll], axis=1), degrees=True
    )  # of the walker, in the world
    rotations = AHEAD @ turned.inv().as_matrix()
    return np.ascontiguousarray(rotations), np.stack([x, y, z], axis=1)
