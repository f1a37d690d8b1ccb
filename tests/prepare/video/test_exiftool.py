"""ExifTool reads the same from the files of these tests, and from the frames, as this project does."""

import json
import shutil
import subprocess
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

pytestmark = pytest.mark.skipif(
    shutil.which("exiftool") is None, reason="exiftool is not installed (libimage-exiftool-perl)"
)


def tags(path: Path) -> dict[str, object]:
    """What ExifTool finds in a file, also in its tracks, by name; of several the first."""
    command = ["exiftool", "-ee", "-n", "-j", str(path)]
    (found,) = json.loads(subprocess.run(command, capture_output=True, check=True).stdout)
    return dict(found)


def test_spherical_metadata(tmp_path: Path) -> None:
    path = add_spherical(write_clip(tmp_path / "a.mp4", known_frames(2)), stereo=1, pose=(10.0, 20.0, -5.0))
    found = tags(add_spherical_xml(path, StereoMode="top-bottom"))
    assert (found["PoseYawDegrees"], found["PosePitchDegrees"], found["PoseRollDegrees"]) == (10, 20, -5)
    assert (found["Stereoscopic3D"], found["StereoMode"]) == (1, "top-bottom")
    assert found["ProjectionType"] == "equirectangular"


@pytest.mark.parametrize(
    ("kind", "packet"),
    [
        (b"gpmd", payload(gps5(PLACE[None]))),
        (b"camm", camm_gps(PLACE)),
        (b"camm", camm(5, *PLACE)),
    ],
)
def test_places(kind: bytes, packet: bytes, tmp_path: Path) -> None:
    path = write_clip(tmp_path / "a.mp4", known_frames(2))
    found = tags(add_track(path, kind, [(0, packet)], 1000))
    assert [found[f"GPS{name}"] for name in ("Latitude", "Longitude", "Altitude")] == pytest.approx(
        PLACE, abs=1e-7
    )


def test_acceleration_and_exposure(tmp_path: Path) -> None:
    path = write_clip(tmp_path / "a.mp4", known_frames(2))
    found = tags(add_track(path, b"camm", [(0, camm(3, 0.5, 9.5, -0.25))], 1000))
    assert found["Acceleration"] == "0.5 9.5 -0.25"
    path = write_clip(tmp_path / "b.mp4", known_frames(2))
    found = tags(add_track(path, b"gpmd", [(0, payload(exposure([0.25], [200])))], 1000))
    assert (found["ExposureTimes"], found["ISOSpeeds"]) == (0.25, 200)


def test_the_stamp_of_a_frame(tmp_path: Path) -> None:
    jpeg = bytes(cv2.imencode(".jpg", np.zeros((64, 128, 3), np.uint8))[1])
    path = tmp_path / "a.jpg"
    path.write_bytes(
        stamped(
            jpeg,
            fix=GpsFix(-33.1234567, -70.5, -12.25),
            attitude=Attitude(None, 10.5, -3.25),
            taken=datetime(2024, 5, 1, 12, 0, 3, 41_667),
            exposure=(0.01, 200),
        )
    )
    found = tags(path)
    assert (found["GPSLatitude"], found["GPSLongitude"]) == pytest.approx((-33.1234567, -70.5), abs=1e-9)
    assert (found["GPSAltitude"], found["ExposureTime"], found["ISO"]) == (-12.25, 0.01, 200)
    assert found["SubSecDateTimeOriginal"] == "2024:05:01 12:00:03.041667+00:00"
    assert (found["PosePitchDegrees"], found["PoseRollDegrees"]) == (10.5, -3.25)
