"""Positions of a recorder at the times of a video's frames."""

from datetime import datetime, timedelta, timezone
from pathlib import Path

import av
import numpy as np
import pytest

from panolog.prepare.video.frames import extract_frames, frame_times
from panolog.prepare.video.telemetry import read_telemetry
from panolog.prepare.world.exif import read_exif
from tests.prepare.video.containers import as_matroska
from tests.prepare.video.videos import short_video

BEGIN = datetime(2026, 5, 17, 10, 0, 0, tzinfo=timezone.utc)
SECONDS = 12


def video(path: Path, begun: datetime | None) -> Path:
    """SECONDS of a grey video whose header says when it begins."""
    with av.open(str(path), "w", options={"movflags": "use_metadata_tags"}) as container:
        if begun is not None:
            container.metadata["creation_time"] = begun.strftime("%Y-%m-%dT%H:%M:%S.000000Z")
        stream = container.add_stream("mpeg4", rate=1)
        stream.width, stream.height, stream.pix_fmt = 64, 32, "yuv420p"
        for _ in range(SECONDS):
            frame = av.VideoFrame.from_ndarray(np.zeros((32, 64, 3), np.uint8), format="rgb24")
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    return path


def gpx(path: Path, first: datetime, seconds: list[float]) -> None:
    """A recorder that goes north by a thousandth of a degree each second."""
    points = "".join(
        f'<trkpt lat="{47 + 0.001 * second}" lon="8"><ele>{400 + second}</ele>'
        f"<time>{(first + timedelta(seconds=second)).isoformat()}</time></trkpt>"
        for second in seconds
    )
    path.write_text(f"<gpx><trk><trkseg>{points}</trkseg></trk></gpx>")


def test_frames_have_the_place_at_their_time(tmp_path: Path) -> None:
    clip = video(tmp_path / "walk.mp4", BEGIN)
    gpx(tmp_path / "walk.gpx", BEGIN - timedelta(seconds=100), [0, 100, 110, 140])
    telemetry, notes = read_telemetry(clip)
    assert telemetry is not None and notes == [f"{tmp_path / 'walk.gpx'}: GPS is taken from it, 2 positions"]
    place = telemetry.fix(5.0)  # between fixes that are 10 seconds apart
    assert place is not None
    assert place.latitude == pytest.approx(47.105) and place.altitude == pytest.approx(505)
    assert telemetry.fix(11.9) is None  # nothing is known of the next 30


@pytest.mark.parametrize(("length", "used"), [(SECONDS - 1, True), (3 * SECONDS, False)])
def test_without_a_clock_a_track_as_long_as_the_video_begins_with_it(
    length: int, used: bool, tmp_path: Path
) -> None:
    clip = video(tmp_path / "walk.mp4", None)
    gpx(tmp_path / "walk.gpx", BEGIN, [float(it) for it in range(length + 1)])
    telemetry, (note,) = read_telemetry(clip)
    assert (telemetry is not None) == used
    if telemetry is not None:
        place = telemetry.fix(3.0)
        assert place is not None and place.latitude == pytest.approx(47.003)
    else:
        assert "the video does not say when it begins, and the positions cover 36 s, not its 12 s" in note


@pytest.mark.parametrize(("length", "said"), [(2 * SECONDS, False), (300 * SECONDS, True)])
def test_a_track_that_outlasts_a_video_by_far_may_be_that_of_a_time_lapse(
    length: int, said: bool, tmp_path: Path
) -> None:
    """A minute of video that was taken in five hours has the places of its first minute."""
    clip = video(tmp_path / "walk.mp4", BEGIN)
    gpx(tmp_path / "walk.gpx", BEGIN, [0, 5, 10, float(length)])
    telemetry, (note,) = read_telemetry(clip)
    assert telemetry is not None
    assert (
        "they cover 3,600 s from the begin of the video, which lasts 12 s: if it is a time" in note
    ) == said


def test_a_track_of_another_time_is_named_and_not_used(tmp_path: Path) -> None:
    clip = video(tmp_path / "walk.mp4", BEGIN)
    gpx(tmp_path / "walk.gpx", BEGIN + timedelta(hours=2), [0, 5])
    telemetry, (note,) = read_telemetry(clip)
    assert telemetry is None
    assert "begins at 2026-05-17 10:00:00 UTC, and the positions are those of 2026-05-17 12:00:00 to" in note


def test_a_file_without_positions_is_named(tmp_path: Path) -> None:
    clip = video(tmp_path / "walk.mp4", BEGIN)
    (tmp_path / "walk.srt").write_text("1\n00:00:00,000 --> 00:00:09,000\nA walk\n")
    assert read_telemetry(clip) == (None, [f"{tmp_path / 'walk.srt'}: has no positions with times: not used"])


def subtitles(path: Path, north: float) -> None:
    cues = (
        f"{n}\n00:00:0{n},000 --> 00:00:0{n},900\n[latitude: {north + n}] [longitude: 8]\n" for n in range(2)
    )
    path.write_text("\n".join(cues))


@pytest.mark.parametrize("later", [0.0, 5.0])
def test_frames_carry_the_places_of_the_file_that_is_there_now(later: float, tmp_path: Path) -> None:
    """Frames are written once, but for those whose places have changed; times count from the first frame."""
    clip = as_matroska(short_video(tmp_path / "walk.avi"), later)
    plain = extract_frames(clip, tmp_path / "frames", parallax=2.0)
    assert read_exif(plain[-1]).fix is None
    times = [int(it.stem.rpartition("_")[2]) / 30 for it in plain]
    assert frame_times(clip, tmp_path / "frames") == pytest.approx(times, abs=2e-3)
    last = times[-1]
    for north in (47.0, 48.0):
        subtitles(tmp_path / "walk.srt", north)
        files = extract_frames(clip, tmp_path / "frames", parallax=2.0)
        fixes = [read_exif(file).fix for file in files]
        assert files == plain
        norths = [None if fix is None else fix.latitude for fix in (fixes[0], fixes[-1])]
        assert norths == pytest.approx([north, north + last], abs=2e-3)
        before = [file.stat().st_mtime_ns for file in files]
        extract_frames(clip, tmp_path / "frames", parallax=2.0)
        assert [file.stat().st_mtime_ns for file in files] == before
    (tmp_path / "walk.srt").unlink()
    assert read_exif(extract_frames(clip, tmp_path / "frames", parallax=2.0)[0]).fix is None
