"""Panoramas of pictures and videos of two fisheye lenses, as cameras store them before stitching."""
