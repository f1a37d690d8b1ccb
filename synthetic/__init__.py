"""A small town that PanoLOG ray-casts itself: the scene of the demo and of tests, with exact ground truth.

`make_town` is all that the rest of the code needs. What stands where: `layout`, `buildings`, `furniture`;
solids: `shapes`; surfaces: `paint`, `facade`; rays and light: `trace`, `light`; the camera's path: `walk`.
"""

from panolog.synthetic.make import make_town

__all__ = ["make_town"]
