"""PanoLOG: posed 360° panoramas of a large outdoor place to one 3D Gaussian Splatting model."""

from importlib.metadata import version

__version__ = version("panolog")
