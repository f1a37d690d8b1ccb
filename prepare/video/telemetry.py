"""What a video's sensors say at any of its times: GPS and which way is up."""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import av
import av.container
import numpy as np
from av.stream import Discard
from numpy.typing import NDArray

from panolog.prepare.video import camm, gpmf
from panolog.prepare.video.decode import FORMATS
from panolog.prepare.world.exif import Attitude, GpsFix
from panolog.scene.errors import SceneError

Array = NDArray[np.float64]

_MOST = 10_000_000  # packets and samples: an accelerometer's of some hours
_APART = 5.0  # seconds between fixes, at most, to interpolate between them
_NEAR = 1.0  # seconds from a fix, at most, where there is none on the other side
_STEPS = (
    1.0  # seconds before and after over which an accelerometer is averaged: a walker makes two steps in each
)
_BLEND = 0.05  # the same of a direction that the camera has already filtered
_HIGHEST = 1e5  # metres, and metres per square second: more is damage
_TILTED = 45.0  # degrees; by more, axes are not those of the picture: who carries a camera holds it upright


@dataclass(frozen=True, eq=False)
class Telemetry:
    """Samples of a video's sensors, by its times in seconds."""

    fix_times: Array  # (N,) ascending
    places: Array  # (N, 3) degrees north, degrees east, metres; the altitude may be NaN
    up_times: Array  # (M,) ascending
    ups: (
        Array  # (M, 3) against gravity, of any length, in the axes of the picture: x right, y down, z forward
    )
    window: float  # seconds before and after over which `ups` are averaged

    def fix(self, time: float) -> GpsFix | None:
        """GPS at a time, interpolated; None where there is none around it."""
        place = _interpolated(self.fix_times, self.places, time)
        if place is None:
            return None
        latitude, longitude, altitude = (float(value) for value in place)
        longitude = (longitude + 180) % 360 - 180
        return GpsFix(latitude, longitude, altitude if math.isfinite(altitude) else None)

    def attitude(self, time: float) -> Attitude | None:
        """Pitch and roll at a time, None where they are not known. The heading is none."""
        first, last = np.searchsorted(self.up_times, [time - self.window, time + self.window])
        up = self.ups[first:last].sum(axis=0) if last > first else None
        if up is None:
            up = _interpolated(self.up_times, self.ups, time)
        if up is None or not np.linalg.norm(up) > 0:
            return None
        x, y, z = up / np.linalg.norm(up)
        return Attitude(None, math.degrees(math.asin(np.clip(z, -1, 1))), math.degrees(math.atan2(-x, -y)))


def read_telemetry(path: Path) -> tuple[Telemetry | None, list[str]]:
    """The telemetry of a video, GPMF or CAMM, None if there is none; and notes on what was left out of it.

    Reads the packets of those tracks alone.

    Raises:
        SceneError: the file cannot be opened as a video.
    """
    found = _Collected()
    try:
        options = {"format_whitelist": FORMATS, "protocol_whitelist": "file"}
        with av.open(str(path.resolve()), options=options, metadata_errors="replace") as container:
            for start, duration, packet in _packets(container):
                found.add(start, duration, packet)
                if found.count > _MOST:
                    return found.telemetry(
                        path, [f"{path}: only the first {_MOST:,} packets of its telemetry were used"]
                    )
    except (av.FFmpegError, UnicodeError) as error:
        raise SceneError(f"{path}: cannot be opened as a video; it is damaged or no video") from error
    return found.telemetry(path, [])


class _Collected:
    """Samples in the order of the file."""

    def __init__(self) -> None:
        self.count = 0  # packets and samples
        self._fixes = _Series()
        self._simple_fixes = _Series()  # without their quality, used if there are no others
        self._gravity = _Series()
        self._acceleration = _Series()  # used if the camera does not tell gravity from it

    def add(self, start: float, duration: float, packet: bytes) -> None:
        """Adds what a packet holds, from `start` on for `duration` in seconds."""
        self.count += 1
        if packet.startswith(b"DEVC"):
            samples = gpmf.parse_payload(packet)
            self.count += self._fixes.add(start, duration, samples.places)
            self.count += self._gravity.add(start, duration, samples.gravity)
            self.count += self._acceleration.add(start, duration, samples.acceleration)
        elif camm.is_packet(packet):
            place, felt = camm.place(packet), camm.acceleration(packet)
            if place is not None:
                fixes = self._fixes if camm.has_quality(packet) else self._simple_fixes
                fixes.add(start, duration, place[None])
            if felt is not None:
                self._acceleration.add(start, duration, felt[None])

    def telemetry(self, path: Path, notes: list[str]) -> tuple[Telemetry | None, list[str]]:
        """What was found, and the notes with those about it."""
        fix_times, places = self._fixes.sorted() if self._fixes.times else self._simple_fixes.sorted()
        possible = (np.abs(places[:, 0]) <= 90) & (np.abs(places[:, 1]) <= 180) & places[:, :2].any(axis=1)
        fix_times, places = fix_times[possible], places[possible].copy()
        places[~(np.abs(places[:, 2]) < _HIGHEST), 2] = np.nan
        filtered = bool(self._gravity.times)
        up_times, ups = (self._gravity if filtered else self._acceleration).sorted()
        felt = (np.abs(ups) < _HIGHEST).all(axis=1) & ups.any(axis=1)
        up_times, ups = up_times[felt], ups[felt]
        if len(ups):
            cosines = -ups[:, 1] / np.linalg.norm(ups, axis=1)
            tilt = float(np.median(np.rad2deg(np.arccos(np.clip(cosines, -1, 1)))))
            if tilt > _TILTED:
                notes.append(
                    f"{path}: by its telemetry, pictures are {tilt:.0f} degrees from upright; its axes are "
                    "others, so it was not used to find up"
                )
                up_times, ups = up_times[:0], ups[:0]
        if not (len(fix_times) or len(up_times)):
            return None, notes
        return Telemetry(fix_times, places, up_times, ups, _BLEND if filtered else _STEPS), notes


class _Series:
    """Samples of one kind, with their times in seconds."""

    def __init__(self) -> None:
        self.times = list[Array]()
        self._values = list[Array]()

    def add(self, start: float, duration: float, values: Array) -> int:
        """Adds values (N, 3), evenly spread from `start` on over `duration`; returns N."""
        if len(values):
            self.times.append(start + duration * np.arange(len(values)) / len(values))
            self._values.append(values)
        return len(values)

    def sorted(self) -> tuple[Array, Array]:
        """(N,) ascending times and (N, 3) values; without those that are not numbers, but for the last."""
        if not self.times:
            return np.zeros(0), np.zeros((0, 3))
        times, values = np.concatenate(self.times), np.concatenate(self._values)
        good = np.isfinite(times) & np.isfinite(values[:, :2]).all(axis=1)
        times, rows = np.unique(times[good], return_index=True)
        return times, values[good][rows]


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
            if packet.size and packet.pts is not None and packet.time_base is not None:
                content, unit = bytes(packet), float(packet.time_base)
                is_known = content.startswith(b"DEVC") or camm.is_packet(content)
                if telemetry.setdefault(packet.stream_index, is_known):
                    yield packet.pts * unit, (packet.duration or 0) * unit, content
    except av.FFmpegError:  # the rest of the file cannot be read
        return


def _interpolated(times: Array, values: Array, time: float) -> Array | None:
    """(3,) between the samples (N, 3) before and after a time; that near it at the ends and in gaps, or None.

    The second value is an angle that wraps at 180 degrees, or too small to.
    """
    after = int(np.searchsorted(times, time))
    before = after - 1
    if before >= 0 and after < len(times) and times[after] - times[before] <= _APART:
        weight = (time - times[before]) / (times[after] - times[before])
        step = values[after] - values[before]
        step[1] = (step[1] + 180) % 360 - 180
        return np.asarray(values[before] + weight * step)
    near = [row for row in (before, after) if 0 <= row < len(times) and abs(times[row] - time) <= _NEAR]
    return values[min(near, key=lambda row: abs(times[row] - time))] if near else None
