"""A small town that PanoLOG ray-casts: the scene of the demo and of tests, with exact ground truth.

`make_town` is all that the rest of the code needs. What stands where and the camera's path: `layout`,
`buildings`, `furniture`; solids: `shapes`; surfaces: `paint`, `facade`; rays and light: `trace`, `light`.
"""

from panolog.synthetic.make import make_town

__all__ = ["make_town"]
