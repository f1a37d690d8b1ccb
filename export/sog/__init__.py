"""SOG (Spatially Ordered Gaussians), PlayCanvas's format of images: one file, or a folder that streams."""
