"""GPS of a recorder, in a file next to a video: GPX, NMEA, or subtitles of DJI.

Sources: www.topografix.com/GPX/1/1; NMEA 0183 as gpsd.gitlab.io/gpsd/NMEA.html has it (GGA, RMC); subtitles
(SRT) in which each entry has [latitude: …] [longitude: …] and, perhaps, [abs_alt: …], as DJI's later ones do.
Earlier ones write GPS(…, …, …), in which either angle comes first: they are not read.

A file may be damaged or made to do harm: it is bounded, and what is not of the format is left out.
"""

import hashlib
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from datetime import date, datetime, timedelta, timezone
from functools import reduce
from pathlib import Path

import numpy as np
from defusedxml.ElementTree import fromstring
from numpy.typing import NDArray

Array = NDArray[np.float64]
Sample = tuple[float, float, float, float]  # seconds; degrees north and east; metres, or NaN

_LARGEST = 64 << 20  # bytes: some days of one place a second
_MOMENT = re.compile(r"(\d{4}-\d\d-\d\d)T(\d\d:\d\d:\d\d)([.,]\d+)?(Z|[+-]\d\d:?\d\d)?")
_SENTENCE = re.compile(r"\$[A-Z]{2}(GGA|RMC),([^*$]*)(?:\*([0-9A-Fa-f]{2}))?")
_CUE = re.compile(r"(\d+):(\d\d):(\d\d)[,.](\d{1,3})\s*-->")
_FIELD = re.compile(r"\b(latitude|longt?itude|abs_alt)\s*:\s*(-?\d+(?:\.\d+)?)")
_DAY = 86_400.0  # seconds


@dataclass(frozen=True, eq=False)
class Track:
    """Where a recorder was."""

    path: Path
    times: Array  # (N,) seconds, ascending: since 1970 in UTC, or since the video begins
    places: Array  # (N, 3) degrees north and east; metres, or NaN
    relative: bool  # whether times count from the begin of the video


def find_track(video: Path) -> Path | None:
    """The file with positions next to a video, which has its name; GPX before NMEA before SRT."""
    found = {it.suffix.lower(): it for it in video.parent.glob("*") if it.stem == video.stem and it.is_file()}
    return next((found[suffix] for suffix in _FORMATS if suffix in found), None)


def track_digest(video: Path) -> str:
    """A digest of that file; empty if there is none. Raises OSError."""
    path = find_track(video)
    return "" if path is None else hashlib.sha256(path.read_bytes()[:_LARGEST]).hexdigest()


def read_track(path: Path) -> Track | None:
    """The positions in a file of one of the formats; None if it has none. Raises OSError."""
    if path.stat().st_size > _LARGEST:
        return None
    samples = [
        it
        for it in _FORMATS[path.suffix.lower()](path.read_bytes())
        if abs(it[1]) <= 90 and abs(it[2]) <= 180
    ]
    if not samples:
        return None
    table = np.array(samples)
    times, rows = np.unique(table[:, 0], return_index=True)
    return Track(path, times, table[rows, 1:], path.suffix.lower() == ".srt")


def _gpx(text: bytes) -> Iterator[Sample]:
    """The points of all tracks that have a time; routes and waypoints are plans."""
    try:
        root = fromstring(text, forbid_dtd=True)
    except (SyntaxError, ValueError, LookupError):  # the last of an encoding that is none
        return
    for point in root.iter():
        if point.tag.rpartition("}")[2] != "trkpt":
            continue
        inside = {child.tag.rpartition("}")[2]: (child.text or "").strip() for child in point}
        time, height = _moment(inside.get("time", "")), number_of(inside.get("ele", ""))
        north, east = number_of(point.get("lat", "")), number_of(point.get("lon", ""))
        if time is not None and np.isfinite([north, east]).all():
            yield time, north, east, height


def _nmea(text: bytes) -> Iterator[Sample]:
    """Places of GGA, which have a height, then of RMC, which have a date."""
    sentences = list(_sentences(text.decode("ascii", "replace")))
    dated = [
        (row, day, time)
        for row, (kind, fields) in enumerate(sentences)
        if kind == "RMC" and (day := _date(fields[8])) and (time := _time_of_day(fields[0])) is not None
    ]
    rows = np.array([row for row, _, _ in dated])
    for wanted, first, status, bad in (("GGA", 1, 5, "0"), ("RMC", 2, 1, "V")):
        for row, (kind, fields) in enumerate(sentences if dated else ()):
            time, place = _time_of_day(fields[0]), _angles(fields[first : first + 4])
            if kind == wanted and fields[status] != bad and time is not None and place is not None:
                _, day, last = dated[int(np.abs(rows - row).argmin())]
                height = number_of(fields[8]) if kind == "GGA" else np.nan
                yield _at(day, time, last), *place, height


def _sentences(text: str) -> Iterator[tuple[str, list[str]]]:
    """The fields of sentences whose checksum is right, if they have one."""
    for found in _SENTENCE.finditer(text):
        body = found[0][1:].partition("*")[0].rstrip()
        given = found[3]
        if given is None or int(given, 16) == reduce(lambda sum_, it: sum_ ^ ord(it), body, 0):
            fields = found[2].strip().split(",")
            if len(fields) >= 9:
                yield found[1], fields


def _angles(fields: list[str]) -> tuple[float, float] | None:
    """Degrees north and east of 4717.112671,N,00833.914843,E."""
    found = []
    for text, direction, names in ((fields[0], fields[1], "NS"), (fields[2], fields[3], "EW")):
        value = number_of(text)
        if not (value >= 0 and direction in tuple(names)):
            return None
        degrees, minutes = divmod(value, 100)
        found.append((degrees + minutes / 60) * (1 if direction == names[0] else -1))
    return found[0], found[1]


def _time_of_day(text: str) -> float | None:
    """Seconds of 162254.00."""
    value = number_of(text)
    hours, rest = divmod(value, 10_000)
    minutes, seconds = divmod(rest, 100)
    return hours * 3600 + minutes * 60 + seconds if hours < 24 and minutes < 60 and seconds < 61 else None


def _date(text: str) -> date | None:
    """The day of 170526."""
    try:
        return datetime.strptime(text, "%d%m%y").date()
    except ValueError:
        return None


def _at(day: date, seconds: float, last: float) -> float:
    """Seconds since 1970 of a time of day that is near another of a day: midnight may be between."""
    turn = round((last - seconds) / _DAY)
    begin = datetime(day.year, day.month, day.day, tzinfo=timezone.utc) + timedelta(days=turn)
    return begin.timestamp() + seconds


def _srt(text: bytes) -> Iterator[Sample]:
    """The places of entries, at the time when each is shown."""
    words = text.decode("utf-8", "replace")
    cues = list(_CUE.finditer(words))
    ends = [*(cue.start() for cue in cues[1:]), len(words)]
    for cue, end in zip(cues, ends, strict=False):
        part = words[cue.end() : end]
        fields = {name.replace("longt", "long"): float(value) for name, value in _FIELD.findall(part)}
        hours, minutes, seconds = (int(it) for it in cue.groups()[:3])
        time = hours * 3600 + minutes * 60 + seconds + float(f"0.{cue[4]}")
        if fields.keys() >= {"latitude", "longitude"} and (fields["latitude"] or fields["longitude"]):
            yield time, fields["latitude"], fields["longitude"], fields.get("abs_alt", np.nan)


def _moment(text: str) -> float | None:
    """Seconds since 1970 of a time as in XML; UTC without a zone."""
    found = _MOMENT.fullmatch(text)
    if found is None:
        return None
    day, time, part, zone = found.groups()
    try:
        offset = "+00:00" if zone in (None, "Z") else f"{zone[:3]}:{zone[-2:]}"
        moment = datetime.fromisoformat(f"{day}T{time}{offset}")
    except ValueError:
        return None
    return moment.timestamp() + float(f"0{(part or '.0').replace(',', '.')}")


def number_of(text: str) -> float:
    """A number; NaN for all else."""
    try:
        return float(text)
    except ValueError:
        return np.nan


_FORMATS: dict[str, Callable[[bytes], Iterator[Sample]]] = {
    ".gpx": _gpx,
    ".nmea": _nmea,
    ".nma": _nmea,
    ".srt": _srt,
}
