"""All that makes a scene: importers, structure from motion, videos, world frames, checks, networks.

OpenCV is imported here, before any module of the package imports pycolmap: in the other order the process
aborts when OpenCV writes a PNG, because both libraries contain zlib.
"""

import cv2 as cv2
