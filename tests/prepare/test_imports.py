"""What importing a module loads and changes, each in a process of its own."""

import subprocess
import sys

import pytest

_ORDER = """
import sys, panolog.prepare.{}, cv2, numpy
assert list(sys.modules).index("cv2") < list(sys.modules).index("pycolmap")
cv2.imencode(".png", numpy.zeros((8, 8, 3), numpy.uint8))
"""
PROGRAMS = {
    "world.gps loads OpenCV before pycolmap: in the other order it cannot write a PNG": _ORDER.format(
        "world.gps"
    ),
    "so does sfm.triangulate, and pycolmap does not take the signal by which a run is stopped": """
import os, signal
seen = []
signal.signal(signal.SIGTERM, lambda *_: seen.append("handled"))
"""
    + _ORDER.format("sfm.triangulate")
    + """
import panolog.prepare.check.bundle
import panolog.prepare.sfm.pipeline
os.kill(os.getpid(), signal.SIGTERM)
assert seen
""",
    "training loads neither onnxruntime nor pycolmap": """
import sys, panolog.workers.training.trainer
import panolog.prepare.networks.depth_maps, panolog.prepare.networks.masks
assert not {"onnxruntime", "pycolmap"} & set(sys.modules)
""",
}


@pytest.mark.parametrize("code", PROGRAMS.values(), ids=PROGRAMS)
def test_imports(code: str) -> None:
    ended = subprocess.run([sys.executable, "-c", code], check=False, capture_output=True, text=True)
    assert (ended.returncode, ended.stderr) == (0, "")
