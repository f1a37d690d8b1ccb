"""Places that PanoLOG ray-casts: the scenes of the demo and of tests, with exact ground truth.

`make_town`, `make_flight` and `make_city` are all that other code needs; `python -m panolog.synthetic` offers
them on the command line. What stands where, and where cameras are: `layout` (a street), `district` (blocks
of houses), `city`, `buildings`, `furniture`; solids: `shapes`; surfaces: `paint`, `facade`; light: `trace`,
`light`.
"""

from panolog.synthetic.make import make_city, make_flight, make_town

__all__ = ["make_city", "make_flight", "make_town"]
