"""PanoLOG: posed 360° panoramas of a large outdoor place to one 3D Gaussian Splatting model."""

__version__: str


def __getattr__(name: str) -> str:
    """The version, looked up when it is asked for: that takes as long as many a command."""
    if name != "__version__":
        raise AttributeError(f"module {__name__} has no attribute {name}")
    from importlib.metadata import version  # noqa: PLC0415

    return version("panolog")
