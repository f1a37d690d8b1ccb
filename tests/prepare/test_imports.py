"""OpenCV is there before pycolmap: in the other order it cannot write a PNG."""

import subprocess
import sys

import pytest


@pytest.mark.parametrize("module", ["world.gps", "sfm.triangulate"])
def test_opencv_comes_first(module: str) -> None:
    code = f"""
import sys, panolog.prepare.{module}, cv2, numpy
assert list(sys.modules).index("cv2") < list(sys.modules).index("pycolmap")
cv2.imencode(".png", numpy.zeros((8, 8, 3), numpy.uint8))
"""
    subprocess.run([sys.executable, "-c", code], check=True)
