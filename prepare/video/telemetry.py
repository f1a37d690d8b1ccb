"""What a video's sensors say at any of its times: GPS, which way is up, and exposure."""

import math
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass, replace
from datetime import datetime, timezone
from pathlib import Path

import av
import av.container
import numpy as np
from av.stream import Discard
from numpy.typing import NDArray

from panolog.prepare.video import camm, gpmf
from panolog.prepare.video.streams import FORMATS, begun, first_shown
from panolog.prepare.world.exif import Attitude, GpsFix
from panolog.prepare.world.tracks import find_track, read_track
from panolog.scene.errors import SceneError

Array = NDArray[np.float64]

_MOST = 10_000_000  # packets and samples: an accelerometer's of some hours
_APART = 5.0  # seconds between samples, at most, to interpolate between them
_RECORDED = 15.0  # the same, of a recorder, which may leave out places on a straight way
_ALIKE = 0.05  # of the length of a video: as long as a recorder's track, if nothing says when it begins
_TOGETHER, _LAPSE = 60.0, 3.0  # seconds between the begins of video and track; times as long as the video
_NEAR = 1.0  # seconds from a sample, at most, where there is none on the other side
_STEPS = 1.0  # seconds before and after over which an accelerometer is averaged: some steps of a walker
_HIGHEST = 1e5  # metres, and metres per square second: more is damage
_TILTED = 45.0  # degrees; by more, axes are not those of the picture: who carries a camera holds it upright


@dataclass(frozen=True, eq=False)
class Series:
    """Samples with their times in seconds."""

    times: Array  # (N,) ascending
    values: Array  # (N, columns)

    def at(self, time: float, apart: float = _APART) -> Array | None:
        """(columns,) at a time, interpolated; at the ends and in gaps those near it, or None.

        Args: apart, seconds between samples, at most, to interpolate between them.
        """
        after = int(np.searchsorted(self.times, time))
        around = [row for row in (after - 1, after) if 0 <= row < len(self.times)]
        if len(around) == 2 and self.times[after] - self.times[after - 1] <= apart:
            part = (time - self.times[after - 1]) / (self.times[after] - self.times[after - 1])
            return np.asarray((1 - part) * self.values[after - 1] + part * self.values[after])
        near = min(around, key=lambda row: abs(self.times[row] - time), default=None)
        return None if near is None or abs(self.times[near] - time) > _NEAR else self.values[near]

    def mean(self, time: float, window: float) -> Array | None:
        """(columns,) the mean of what is up to `window` seconds from a time; as `at` if there is nothing."""
        first, last = np.searchsorted(self.times, [time - window, time + window])
        return np.asarray(self.values[first:last].mean(axis=0)) if last > first else self.at(time)

    def only(self, rows: NDArray[np.intp]) -> "Series":
        """The samples in some rows (M,)."""
        return Series(self.times[rows], self.values[rows])


@dataclass(frozen=True, eq=False)
class Telemetry:
    """Samples of a video's sensors."""

    places: Series  # degrees north; degrees east, which continue beyond 180; metres, or NaN
    ups: Series  # x, y, z against gravity, of any length, in the picture's axes: right, down, forward
    window: float  # seconds before and after over which `ups` are averaged
    shutter: Series  # seconds of exposure
    sensitivity: Series  # ISO
    apart: float = _APART  # seconds between two places, at most, to interpolate between them

    def fix(self, time: float) -> GpsFix | None:
        """GPS at a time, interpolated; None where there is none around it."""
        place = self.places.at(time, self.apart)
        if place is None:
            return None
        latitude, longitude, altitude = (float(value) for value in place)
        east = (longitude + 180) % 360 - 180
        return GpsFix(latitude, east, altitude if math.isfinite(altitude) else None)

    def attitude(self, time: float) -> Attitude | None:
        """Pitch and roll at a time, None where they are not known. The heading is none."""
        up = self.ups.mean(time, self.window)
        if up is None or not np.linalg.norm(up) > 0:
            return None
        x, y, z = up / np.linalg.norm(up)
        return Attitude(None, math.degrees(math.asin(np.clip(z, -1, 1))), math.degrees(math.atan2(-x, -y)))

    def exposure(self, time: float) -> tuple[float, float] | None:
        """Seconds and ISO at a time; None if one of them is not known."""
        shutter, sensitivity = self.shutter.at(time), self.sensitivity.at(time)
        if shutter is None or sensitivity is None:
            return None
        return float(shutter[0]), float(sensitivity[0])


def read_telemetry(path: Path) -> tuple[Telemetry | None, list[str]]:
    """The telemetry of a video, GPMF or CAMM, None if there is none; and notes on what was left out of it.

    Reads the packets of those tracks alone. Places are those of a recorder, if its file is next to the video.

    Raises SceneError: the file cannot be opened as a video; OSError: that of the recorder cannot be read.
    """
    found = _Collected()
    notes = []
    try:
        options = {"format_whitelist": FORMATS, "protocol_whitelist": "file"}
        with av.open(str(path.resolve()), options=options, metadata_errors="replace") as container:
            started, lasts = begun(container), max(0, container.duration or 0) / av.time_base
            first = first_shown(container)
            for start, duration, packet in _packets(container):
                found.add(start, duration, packet)
                if found.count > _MOST:
                    notes.append(f"{path}: only the first {_MOST:,} samples of its telemetry were used")
                    break
    except (av.FFmpegError, UnicodeError) as error:
        raise SceneError(f"{path}: cannot be opened as a video; it is damaged or no video") from error
    ups = found.ups()
    if len(ups.times):
        cosines = -ups.values[:, 1] / np.linalg.norm(ups.values, axis=1)
        tilt = float(np.median(np.rad2deg(np.arccos(np.clip(cosines, -1, 1)))))
        if tilt > _TILTED:
            notes.append(
                f"{path}: by its telemetry, pictures are {tilt:.0f} degrees from upright; its axes are "
                "others, so it was not used to find up"
            )
            ups = ups.only(np.zeros(0, np.intp))
    telemetry = Telemetry(
        found.places(), ups, found.window, found.above_0("shutter"), found.above_0("sensitivity")
    )
    if (file := find_track(path)) is not None:
        begin = None if started is None else started.timestamp()
        recorded, line = _recorded(file, begin, lasts)
        notes.append(line)
        if recorded is not None:
            places = replace(recorded, times=recorded.times + first)
            telemetry = replace(telemetry, places=places, apart=_RECORDED)
    series = (telemetry.places, telemetry.ups, telemetry.shutter)
    return (telemetry if any(len(it.times) for it in series) else None), notes


def _recorded(path: Path, begin: float | None, lasts: float) -> tuple[Series | None, str]:
    """The places of a recorder by the time of a video, None if none are of it; and a note on that.

    Args: path, of the recorder's file; begin, of the video in seconds since 1970; lasts, for so many seconds.
    """
    track = read_track(path)
    if track is None:
        return None, f"{path}: has no positions with times: not used"
    times, length = track.times, float(np.ptp(track.times))
    if not track.relative:
        if begin is None and abs(length - lasts) > max(_NEAR, _ALIKE * lasts):
            return None, (
                f"{path}: not used, as the video does not say when it begins, and the positions cover "
                f"{length:.0f} s, not its {lasts:.0f} s; write creation_time into the video"
            )
        times = times - (times[0] if begin is None else begin)
    inside = int(((times >= -_NEAR) & (times <= lasts + _NEAR)).sum())
    if inside == 0:
        spans = [datetime.fromtimestamp(it, timezone.utc) for it in (begin or 0.0, *track.times[[0, -1]])]
        shown = [f"{it:%Y-%m-%d %H:%M:%S}" for it in spans]
        return None, (
            f"{path}: not used, as the video begins at {shown[0]} UTC, and the positions are those of "
            f"{shown[1]} to {shown[2]}; correct the clock of one, such as creation_time of the video"
        )
    line = f"{path}: GPS is taken from it, {inside:,} positions"
    if not track.relative and abs(times[0]) <= _TOGETHER and length > _LAPSE * lasts:
        line += (
            f"; they cover {length:,.0f} s from the begin of the video, which lasts {lasts:,.0f} s: if it is"
            " a time lapse, its time is not theirs: remove or rename the file"
        )
    return _on_earth(times, track.places), line


class _Collected:
    """Samples in the order of the file, by what they are."""

    def __init__(self) -> None:
        self.count = 0  # packets and samples
        self._times: dict[str, list[Array]] = defaultdict(list)
        self._values: dict[str, list[Array]] = defaultdict(list)

    def add(self, start: float, duration: float, packet: bytes) -> None:
        """Adds what a packet holds, from `start` on for `duration` in seconds."""
        self.count += 1
        if packet.startswith(b"DEVC"):
            samples = gpmf.parse_payload(packet)
            for name, values in vars(samples).items():
                self._spread(name, start, duration, values)
        elif camm.is_packet(packet):
            place, felt = camm.place(packet), camm.acceleration(packet)
            if place is not None:
                self._spread("places" if camm.has_quality(packet) else "simple", start, 0.0, place[None])
            if felt is not None:
                self._spread("acceleration", start, 0.0, felt[None])

    @property
    def window(self) -> float:
        """Seconds before and after over which directions are averaged: the camera has filtered gravity."""
        return 0.0 if self._times["gravity"] else _STEPS

    def places(self) -> Series:
        """The places with their quality, or else the others; without what cannot be."""
        found = self._series("places" if self._times["places"] else "simple", 3)
        return _on_earth(found.times, found.values)

    def ups(self) -> Series:
        """Directions of up: of gravity, or else of an accelerometer."""
        found = self._series("gravity" if self._times["gravity"] else "acceleration", 3)
        possible = (np.abs(found.values) < _HIGHEST).all(axis=1) & found.values.any(axis=1)
        return found.only(np.flatnonzero(possible))

    def above_0(self, name: str) -> Series:
        """Numbers that are above 0."""
        found = self._series(name, 1)
        return found.only(np.flatnonzero((found.values[:, 0] > 0) & (found.values[:, 0] < _HIGHEST)))

    def _spread(self, name: str, start: float, duration: float, values: Array) -> None:
        """Adds values (N, columns), evenly spread over the duration."""
        if len(values):
            self.count += len(values)
            self._times[name].append(start + duration * np.arange(len(values)) / len(values))
            self._values[name].append(values)

    def _series(self, name: str, columns: int) -> Series:
        """The samples of a name, in the order of time, each time once."""
        times = np.concatenate([np.zeros(0), *self._times[name]])
        values = np.concatenate([np.zeros((0, columns)), *self._values[name]])
        times, rows = np.unique(times, return_index=True)
        return Series(times, values[rows])


def _on_earth(times: Array, places: Array) -> Series:
    """Places (N, 3) without what cannot be; degrees east continue beyond 180."""
    on_earth = (np.abs(places[:, :2]) <= (90, 180)).all(axis=1)
    found = Series(times, places).only(np.flatnonzero(on_earth & places[:, :2].any(axis=1)))
    north, east, height = found.values.T
    high = np.where(np.abs(height) < _HIGHEST, height, np.nan)
    return Series(found.times, np.stack([north, np.unwrap(east, period=360), high], axis=1))


def _packets(container: av.container.InputContainer) -> Iterator[tuple[float, float, bytes]]:
    """Start and duration in seconds, and the content, of each packet of telemetry."""
    for stream in container.streams:
        if stream.type != "data":
            stream.discard = Discard.all
    if not container.streams.data:
        return
    telemetry = dict[int, bool]()  # by the first packet of each stream
    try:
        for packet in container.demux(*container.streams.data):
            if packet.size and packet.pts is not None and packet.time_base:
                content, unit = bytes(packet), float(packet.time_base)
                is_known = content.startswith(b"DEVC") or camm.is_packet(content)
                if telemetry.setdefault(packet.stream_index, is_known):
                    yield packet.pts * unit, (packet.duration or 0) * unit, content
    except av.FFmpegError:  # the rest of the file cannot be read
        return
