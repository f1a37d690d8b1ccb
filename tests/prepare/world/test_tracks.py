"""Positions of a recorder in a file next to a video: GPX, NMEA and subtitles."""

from datetime import datetime, timezone
from functools import reduce
from pathlib import Path

import numpy as np
import pytest

from panolog.prepare.world import tracks
from panolog.prepare.world.tracks import find_track, read_track

BEGIN = datetime(2026, 5, 17, 23, 59, 58, tzinfo=timezone.utc).timestamp()
GPX = """<?xml version="1.0" encoding="UTF-8"?>
<gpx version="1.{minor}" xmlns="http://www.topografix.com/GPX/1/{minor}">
<metadata><time>2020-01-01T00:00:00Z</time></metadata>
<wpt lat="1" lon="2"><time>2026-05-17T23:59:58Z</time></wpt><rte><rtept lat="1" lon="2"/></rte>
<trk><trkseg>
<trkpt lat="47.5" lon="8.25"><ele>408.5</ele><time>2026-05-17T23:59:58Z</time></trkpt>
<trkpt lat="47.6" lon="8.35"><time>2026-05-18T01:59:59.5+02:00</time></trkpt>
<trkpt lat="47.9" lon="8.9"><time>yesterday</time></trkpt>
<trkpt lat="97.9" lon="8.9"><time>2026-05-18T00:00:00Z</time></trkpt>
</trkseg><trkseg>
<trkpt lat="47.7" lon="8.45"><ele>x</ele><time>2026-05-18T00:00:02</time></trkpt></trkseg></trk></gpx>"""


def sentence(body: str) -> str:
    return f"${body}*{reduce(lambda sum_, it: sum_ ^ ord(it), body, 0):02X}\r\n"


NMEA = (
    sentence("GPGGA,235958.00,4730.0,N,00815.0,E,1,08,0.9,408.5,M,47.0,M,,")
    + sentence("GPRMC,235958.00,A,4730.0,N,00815.0,E,1.0,,170526,,,A")
    + sentence("GPGSV,1,1,00")
    + sentence("GNGGA,235959.50,4736.0,N,00821.0,E,4,08,0.9,,M,47.0,M,,")
    + sentence("GNGGA,000000.00,4736.0,N,00821.0,E,0,08,0.9,,M,47.0,M,,")  # no fix
    + "$GPGGA,000001.00,4700.0,N,00800.0,E,1,08,0.9,1.0,M,47.0,M,,*00\r\n"  # damaged
    + sentence("GPRMC,000002.00,A,4742.0,N,00827.0,E,1.0,,180526,,,A")
    + sentence("GPRMC,000003.00,V,4742.0,N,00827.0,E,1.0,,180526,,,N")  # not valid
)
SRT = """1
00:00:00,000 --> 00:00:00,033
<font size="28">FrameCnt: 1 [iso: 100] [latitude: 47.5] [longitude: 8.25] [rel_alt: 1.3 abs_alt: 408.5]</font>

2
00:00:01,500 --> 00:00:01,533
[latitude : 47.6] [longtitude : 8.35]

3
00:00:02,000 --> 00:00:02,033
[latitude: 0.0] [longitude: 0.0]

4
00:00:04,000 --> 00:00:04,033
[latitude: 47.7] [longitude: 8.45] GPS(8.0,47.0,16)
"""
TEXTS = {"gpx": GPX.format(minor=1), "GPX": GPX.format(minor=0), "nmea": NMEA, "srt": SRT}


@pytest.mark.parametrize("suffix", TEXTS)
def test_places_and_times_of_each_format(suffix: str, tmp_path: Path) -> None:
    (tmp_path / f"walk.{suffix}").write_text(TEXTS[suffix])
    path = find_track(tmp_path / "walk.mp4")
    assert path == tmp_path / f"walk.{suffix}"
    track = read_track(path)
    assert track is not None and track.relative == (suffix == "srt")
    wanted = np.array([0.0, 1.5, 4.0]) + (0 if track.relative else BEGIN)
    np.testing.assert_allclose(track.times, wanted, atol=1e-3)
    np.testing.assert_allclose(track.places[:, :2], [[47.5, 8.25], [47.6, 8.35], [47.7, 8.45]], atol=1e-9)
    np.testing.assert_array_equal(track.places[:, 2], [408.5, np.nan, np.nan])


def test_nmea_before_its_first_date_and_south_west(tmp_path: Path) -> None:
    path = tmp_path / "a.nmea"
    path.write_text(
        sentence("GPGGA,235957.00,3330.0,S,17015.0,W,1,08,0.9,-5.5,M,47.0,M,,")
        + sentence("GPRMC,000002.00,A,3330.0,S,17015.0,W,1.0,,180526,,,A")
    )
    track = read_track(path)
    assert track is not None
    np.testing.assert_allclose(track.times - BEGIN, [-1, 4])
    np.testing.assert_allclose(track.places[0], [-33.5, -170.25, -5.5])


def test_only_a_file_of_that_name_counts(tmp_path: Path) -> None:
    assert find_track(tmp_path / "walk.mp4") is None
    for name in ("walk2.gpx", "walk.txt", "walk.gpx.bak"):
        (tmp_path / name).write_text(GPX)
    (tmp_path / "walk.srt").mkdir()
    assert find_track(tmp_path / "walk.mp4") is None
    (tmp_path / "walk.nmea").touch()
    (tmp_path / "walk.gpx").touch()
    assert find_track(tmp_path / "walk.mp4") == tmp_path / "walk.gpx"


BOMB = '<!DOCTYPE a [<!ENTITY b "' + "x" * 99 + '">]><gpx><trk><trkseg>&b;</trkseg></trk></gpx>'
DAMAGED = {
    "gpx": ["", "<gpx>", BOMB, "\0\xff" * 99, GPX.format(minor=1).replace("trkpt", "point"), "<a>" * 5000],
    "nmea": ["", "$GP", "$GPRMC,,,,,,,,,,\n" * 99, sentence("GPGGA,235958.00,4730.0,N,00815.0,E,1,8,1,4,M,")],
    "srt": ["", "1\n00:00:01,000 --> 00:00:02,000\nHello\n", "[latitude: 1] [longitude: 2]", "\0" * 99],
}


@pytest.mark.parametrize(("suffix", "number"), [(it, n) for it in DAMAGED for n in range(len(DAMAGED[it]))])
def test_what_has_no_positions_is_none(suffix: str, number: int, tmp_path: Path) -> None:
    path = tmp_path / f"a.{suffix}"
    path.write_text(DAMAGED[suffix][number])
    assert read_track(path) is None


def test_no_more_is_read_than_any_recorder_writes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "a.srt"
    path.write_text(SRT)
    monkeypatch.setattr(tracks, "_LARGEST", 10)
    assert read_track(path) is None


@pytest.mark.parametrize("suffix", TEXTS)
def test_damage_anywhere_raises_nothing(suffix: str, tmp_path: Path) -> None:
    random, whole, path = np.random.default_rng(0), TEXTS[suffix].encode(), tmp_path / f"a.{suffix}"
    for _ in range(200):
        damaged = bytearray(whole)
        for at in random.integers(0, len(whole), 3):
            damaged[at] = random.integers(0, 256)
        path.write_bytes(damaged[: random.integers(1, len(whole))])
        track = read_track(path)
        assert track is None or np.isfinite(track.places[:, :2]).all()
