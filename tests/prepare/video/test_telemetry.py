"""GPS and gravity of a video's telemetry, at the times of its frames, and as its frames carry them."""

import json
import shutil
import subprocess
from collections.abc import Callable
from datetime import datetime
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from panolog.prepare.video.frames import extract_frames
from panolog.prepare.video.gpmf import parse_payload
from panolog.prepare.video.stamp import stamped
from panolog.prepare.video.telemetry import Telemetry, read_telemetry
from panolog.prepare.world.exif import Attitude, GpsFix, read_exif
from panolog.scene.image_files import decode
from tests.prepare.video.containers import add_spherical, add_track, known_frames, write_clip
from tests.prepare.video.sensors import accl, camm, camm_gps, exposure, gps5, gps9, grav, payload, up_of
from tests.prepare.video.videos import tour_images, write_video

Array = NDArray[np.float64]
SECONDS = 4


def place(time: float) -> Array:
    """(3,) where the camera is at a time in seconds: it moves evenly, through 180 degrees east."""
    return np.array([-33.5 + 2e-4 * time, (179.9997 + 2e-4 * time + 180) % 360 - 180, 50 + time])


def attitude(time: float) -> tuple[float, float]:
    """Degrees of pitch and roll."""
    return 10 + 3 * time, -20 + 5 * time


def up(time: float) -> Array:
    return up_of(*attitude(time))


def gpmf_track(
    stream: Callable[[Array], bytes], value: Callable[[float], Array], rate: int
) -> list[tuple[int, bytes]]:
    """A payload each second, with `rate` samples."""
    return [
        (1000 * second, payload(stream(np.stack([value(second + n / rate) for n in range(rate)]))))
        for second in range(SECONDS)
    ]


def camm_track(packet: Callable[[float], bytes], rate: int) -> list[tuple[int, bytes]]:
    return [(1000 * n // rate, packet(n / rate)) for n in range(SECONDS * rate)]


def with_track(path: Path, kind: bytes, samples: list[tuple[int, bytes]]) -> Path:
    """A clip with a track of telemetry, and one of something else."""
    add_track(write_clip(path, known_frames(2)), b"fdsc", [(0, b"GPRO" * 8)], 1000)
    return add_track(path, kind, samples, 1000 * SECONDS)


def read(path: Path) -> Telemetry:
    """The telemetry, of which nothing was left out."""
    found, notes = read_telemetry(path)
    assert found is not None and notes == []
    return found


@pytest.mark.parametrize(
    ("kind", "samples"),
    [
        (b"gpmd", gpmf_track(gps5, place, 18)),
        (b"gpmd", gpmf_track(gps9, place, 10)),
        (b"camm", camm_track(lambda time: camm_gps(place(time)), 5)),
        (b"camm", camm_track(lambda time: camm(5, *place(time)), 1)),
    ],
    ids=["GPS5", "GPS9", "camm 6", "camm 5"],
)
def test_gps_is_interpolated(kind: bytes, samples: list[tuple[int, bytes]], tmp_path: Path) -> None:
    found = read(with_track(tmp_path / "clip.mp4", kind, samples))
    for time in (0.0, 0.51, 1.4999, 1.5001, 2.3):
        fix = found.fix(time)
        assert fix is not None and fix.altitude is not None
        latitude, longitude, altitude = place(time)
        assert fix.latitude == pytest.approx(latitude, abs=1.1e-7)
        assert (fix.longitude - longitude + 180) % 360 - 180 == pytest.approx(0, abs=1.1e-7)
        assert fix.altitude == pytest.approx(altitude, abs=0.002)
    assert found.fix(60.0) is None and found.fix(-2.0) is None
    assert found.attitude(1.0) is None


@pytest.mark.parametrize(
    ("kind", "samples", "within"),
    [
        (b"gpmd", gpmf_track(grav, up, 30), 0.1),
        (b"gpmd", gpmf_track(accl, up, 200), 0.3),
        (b"gpmd", gpmf_track(lambda ups: accl(ups, "zxY"), up, 200), 0.3),
        (b"camm", camm_track(lambda time: camm(3, *(9.81 * up(time) * (1, -1, -1))), 100), 0.3),
    ],
    ids=["GRAV", "ACCL", "ACCL ORIN", "camm 3"],
)
def test_up_is_known_at_each_time(
    kind: bytes, samples: list[tuple[int, bytes]], within: float, tmp_path: Path
) -> None:
    found = read(with_track(tmp_path / "clip.mp4", kind, samples))
    for time in (1.1, 1.5, 2.2):  # an accelerometer is averaged over a second before and after
        seen = found.attitude(time)
        assert seen is not None and seen.heading is None
        assert (seen.pitch, seen.roll) == pytest.approx(attitude(time), abs=within)
        assert seen.up == pytest.approx(up(time), abs=0.01)
    assert found.fix(1.0) is None


def test_gravity_is_preferred_to_an_accelerometer_and_its_steps_are_averaged(tmp_path: Path) -> None:
    random = np.random.default_rng(0)
    shaken = np.stack([up_of(10, 5) + random.normal(0, 0.2, 3) for _ in range(200 * SECONDS)])
    samples = [(1000 * n, payload(accl(shaken[200 * n : 200 * (n + 1)]))) for n in range(SECONDS)]
    seen = read(with_track(tmp_path / "a.mp4", b"gpmd", samples)).attitude(2.0)
    assert seen is not None and (seen.pitch, seen.roll) == pytest.approx((10, 5), abs=3)
    both = payload(accl(np.stack([up_of(30, 0)])), grav(np.stack([up_of(10, 5)])))
    seen = read(with_track(tmp_path / "b.mp4", b"gpmd", [(0, both)])).attitude(0.0)
    assert seen is not None and (seen.pitch, seen.roll) == pytest.approx((10, 5), abs=0.1)


def test_places_without_a_fix_are_none(tmp_path: Path) -> None:
    here = np.stack([place(0.0)])
    for number, (kind, packet) in enumerate(
        [
            (b"gpmd", payload(gps5(here, fix=0))),
            (b"gpmd", payload(gps5(here, dilution=9_999))),
            (b"gpmd", payload(gps9(here, fix=0))),
            (b"gpmd", payload(gps5(0 * here))),
            (b"camm", camm_gps(place(0.0), fix=0)),
            (b"camm", camm(5, 91.0, 0.0, 0.0)),
            (b"camm", camm(5, float("nan"), 0.0, 0.0)),
        ]
    ):
        assert read_telemetry(with_track(tmp_path / f"{number}.mp4", kind, [(0, packet)])) == (None, [])
    for number, (kind, packet) in enumerate(
        [
            (b"gpmd", payload(gps5(here, fix=2))),
            (b"gpmd", payload(gps9(here, fix=2))),
            (b"camm", camm_gps(place(0.0), fix=2)),
            (b"camm", camm(5, -33.5, 179.9997, 1e9)),
        ]
    ):
        fix = read(with_track(tmp_path / f"flat{number}.mp4", kind, [(0, packet)])).fix(0.0)
        assert fix is not None and fix.altitude is None
        assert (fix.latitude, fix.longitude) == pytest.approx((-33.5, 179.9997), abs=1e-7)


def test_axes_that_are_not_the_pictures_are_left_out(tmp_path: Path) -> None:
    samples = camm_track(lambda time: camm(3, 1.1, 0.1, 9.7), 10)  # z is up, as of a camera on its back
    found, notes = read_telemetry(with_track(tmp_path / "clip.mp4", b"camm", samples))
    assert found is None
    (line,) = notes
    assert "clip.mp4: by its telemetry, pictures are 8" in line and "not used to find up" in line


def test_exposure_is_known(tmp_path: Path) -> None:
    samples = [
        (0, payload(exposure([1 / 100] * 10, [200] * 10))),
        (1000, payload(exposure([1 / 400], [100]))),
    ]
    found = read(with_track(tmp_path / "clip.mp4", b"gpmd", samples))
    assert found.exposure(0.5) == pytest.approx((1 / 100, 200), rel=1e-6)
    assert found.exposure(1.0) == pytest.approx((1 / 400, 100), rel=1e-6)
    assert found.exposure(9.0) is None
    nothing = with_track(tmp_path / "b.mp4", b"gpmd", [(0, payload(exposure([0.0], [0])))])
    assert read_telemetry(nothing) == (None, [])


def test_a_video_without_telemetry(tmp_path: Path) -> None:
    for suffix in ("mp4", "mkv"):
        assert read_telemetry(write_clip(tmp_path / f"clip.{suffix}", known_frames(2))) == (None, [])


@pytest.mark.parametrize("seed", range(20))
def test_damaged_payloads_hold_nothing_or_something(seed: int) -> None:
    random = np.random.default_rng(seed)
    times = np.arange(20) / 20
    ups, places = np.stack([up(it) for it in times]), np.stack([place(it) for it in times])
    whole = bytearray(payload(gps5(places), gps9(places), grav(ups), accl(ups, "zxY")))
    for _ in range(200):
        data = whole.copy()
        for at in random.integers(0, len(data), random.integers(1, 6)):
            data[at] = random.integers(256)
        found = parse_payload(bytes(data[: random.integers(1, len(data))]))
        assert all(part.shape[1:] == (3,) for part in (found.places, found.gravity, found.acceleration))
    assert len(parse_payload(bytes(whole)).places) == 40


def test_a_stamp_is_read_as_it_was_written(tmp_path: Path) -> None:
    jpeg = bytes(cv2.imencode(".jpg", np.zeros((64, 128, 3), np.uint8))[1])
    path, now = tmp_path / "a.jpg", datetime(2024, 5, 1, 12, 0, 3, 41_667)
    attitude = Attitude(None, -12.3456, 170.5)
    for fix, taken, light in (
        (GpsFix(-33.123456789, -70.987654321, -12.345), now, None),
        (GpsFix(0.5, 179.9999999, None), None, (0.01, 200)),
        (GpsFix(89.0, 0.0, 0.0), now, (0.01, 200)),
        (None, now, (0.01, 200)),
    ):
        path.write_bytes(stamped(jpeg, fix=fix, attitude=attitude, taken=taken, exposure=light))
        found = read_exif(path)
        assert (found.attitude, found.time, found.fix is None) == (attitude, taken, fix is None)
        assert found.exposure_stops == (light and pytest.approx(np.log2(0.02), abs=1e-4))
        if fix is not None and found.fix is not None:
            written = (fix.latitude, fix.longitude)
            assert (found.fix.latitude, found.fix.longitude) == pytest.approx(written, abs=1e-9)
            assert found.fix.altitude == fix.altitude
        assert decode(path, cv2.IMREAD_COLOR).shape == (64, 128, 3)
    assert stamped(jpeg, fix=None, attitude=None, taken=None) == jpeg


@pytest.mark.nightly
@pytest.mark.skipif(shutil.which("exiftool") is None, reason="no exiftool: libimage-exiftool-perl")
def test_exiftool_reads_the_stamp_of_a_frame(tmp_path: Path) -> None:
    jpeg, path = bytes(cv2.imencode(".jpg", np.zeros((64, 128, 3), np.uint8))[1]), tmp_path / "a.jpg"
    fix, attitude = GpsFix(-33.1234567, -70.5, -12.25), Attitude(None, 10.5, -3.25)
    taken = datetime(2024, 5, 1, 12, 0, 3, 41_667)
    path.write_bytes(stamped(jpeg, fix=fix, attitude=attitude, taken=taken, exposure=(0.01, 200)))
    command = ["exiftool", "-ee", "-n", "-j", str(path)]
    (found,) = json.loads(subprocess.run(command, capture_output=True, check=True).stdout)
    assert (found["GPSLatitude"], found["GPSLongitude"]) == pytest.approx((-33.1234567, -70.5), abs=1e-9)
    assert (found["GPSAltitude"], found["ExposureTime"], found["ISO"]) == (-12.25, 0.01, 200)
    assert found["SubSecDateTimeOriginal"] == "2024:05:01 12:00:03.041667+00:00"
    assert (found["PosePitchDegrees"], found["PoseRollDegrees"]) == (10.5, -3.25)


@pytest.mark.system
def test_the_pose_of_the_header_is_that_of_all_frames(tmp_path: Path) -> None:
    path = write_video(tmp_path / "walk.mp4", tour_images(30, 45, 2), fourcc="mp4v", fps=2)
    files = extract_frames(add_spherical(path, pose=(40.0, 12.0, -7.0)), tmp_path / "out", parallax=2.0)
    for file in files:
        assert read_exif(file).attitude == Attitude(None, 12.0, 7.0)
