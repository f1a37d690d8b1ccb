"""Conversion of poses to our convention: camera x right, y down, z forward, world-to-camera."""

import numpy as np
from numpy.typing import NDArray

from panolog.scene.errors import SceneError

Array = NDArray[np.float64]
FLIP_YZ = np.diag([1.0, -1.0, -1.0])  # OpenGL's camera (x right, y up, z backward) to ours, and back
