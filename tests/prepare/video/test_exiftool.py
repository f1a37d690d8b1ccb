"""ExifTool reads the same from the files of these tests, and from the frames, as this project does."""

import json
import shutil
import subprocess
from collections.abc import Callable
from datetime import datetime
from pathlib import Path

import cv2
import numpy as np
import pytest

from panolog.prepare.video.stamp import stamped
from panolog.prepare.world.exif import Attitude, GpsFix
from tests.prepare.video.containers import (
    add_spherical,
    add_spherical_xml,
    add_track,
    known_frames,
    write_clip,
)
from tests.prepare.video.sensors import camm, camm_gps, exposure, gps5, payload

PLACE = np.array([-47.1234567, 8.7654321, 400.125])

pytestmark = [
    pytest.mark.nightly,
    pytest.mark.skipif(shutil.which("exiftool") is None, reason="no exiftool: libimage-exiftool-perl"),
]


def tags(path: Path) -> dict[str, object]:
    """What ExifTool finds in a file, also in its tracks, by name; of several the first."""
    command = ["exiftool", "-ee", "-n", "-j", str(path)]
    (found,) = json.loads(subprocess.run(command, capture_output=True, check=True).stdout)
    return dict(found)


def with_track(kind: bytes, packet: bytes) -> Callable[[Path], Path]:
    return lambda path: add_track(path, kind, [(0, packet)], 1000)


def spherical(path: Path) -> Path:
    return add_spherical_xml(add_spherical(path, stereo=1, pose=(10.0, 20.0, -5.0)), StereoMode="top-bottom")


PLACED = dict(zip(("GPSLatitude", "GPSLongitude", "GPSAltitude"), PLACE.tolist(), strict=True))
SPHERICAL: dict[str, float | str] = {"PoseYawDegrees": 10, "PosePitchDegrees": 20, "PoseRollDegrees": -5}
SPHERICAL |= {"Stereoscopic3D": 1, "StereoMode": "top-bottom", "ProjectionType": "equirectangular"}


@pytest.mark.parametrize(
    ("change", "wanted"),
    [
        (spherical, SPHERICAL),
        (with_track(b"gpmd", payload(gps5(PLACE[None]))), PLACED),
        (with_track(b"camm", camm_gps(PLACE)), PLACED),
        (with_track(b"camm", camm(5, *PLACE)), PLACED),
        (with_track(b"camm", camm(3, 0.5, 9.5, -0.25)), {"Acceleration": "0.5 9.5 -0.25"}),
        (with_track(b"gpmd", payload(exposure([0.25], [200]))), {"ExposureTimes": 0.25, "ISOSpeeds": 200}),
    ],
)
def test_metadata_of_videos(
    change: Callable[[Path], Path], wanted: dict[str, float | str], tmp_path: Path
) -> None:
    found = tags(change(write_clip(tmp_path / "a.mp4", known_frames(2))))
    for name, value in wanted.items():
        assert found[name] == (value if isinstance(value, str) else pytest.approx(value, abs=1e-7)), name


def test_the_stamp_of_a_frame(tmp_path: Path) -> None:
    jpeg = bytes(cv2.imencode(".jpg", np.zeros((64, 128, 3), np.uint8))[1])
    path = tmp_path / "a.jpg"
    fix, attitude = GpsFix(-33.1234567, -70.5, -12.25), Attitude(None, 10.5, -3.25)
    taken = datetime(2024, 5, 1, 12, 0, 3, 41_667)
    path.write_bytes(stamped(jpeg, fix=fix, attitude=attitude, taken=taken, exposure=(0.01, 200)))
    found = tags(path)
    assert (found["GPSLatitude"], found["GPSLongitude"]) == pytest.approx((-33.1234567, -70.5), abs=1e-9)
    assert (found["GPSAltitude"], found["ExposureTime"], found["ISO"]) == (-12.25, 0.01, 200)
    assert found["SubSecDateTimeOriginal"] == "2024:05:01 12:00:03.041667+00:00"
    assert (found["PosePitchDegrees"], found["PoseRollDegrees"]) == (10.5, -3.25)
