"""GoPro's telemetry, GPMF: GPS, gravity and exposure in the payloads of the track gpmd.

Sources: github.com/gopro/gpmf-parser, README.md: keys, types, scales, the axes of the accelerometer (X right,
Y forward, Z up, stored in the order of ORIN, or else Z, X, Y) and what each key means. GRAV is the direction
of gravity in the axes of the picture, x right, y down, z forward, as OpenImuCameraCalibrator
(github.com/urbste) uses it; GoPro confirms in issue 170 that these are the accelerometer's x, −z, −y.
"""

import struct
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_NUMBERS = ("i1", "u1", ">i2", ">u2", ">i4", ">u4", ">i8", ">u8", ">f4", ">f8")
_TYPES = dict(zip("bBsSlLjJfd", _NUMBERS, strict=True))
_NESTED, _COMPLEX = "\0", "?"
_POOR = 1_000  # hundreds of DOP, dilution of precision; "under 500 is good"
_GPS5_FIELDS, _GPS9_FIELDS, _GPS9_DOP, _GPS9_FIX = 5, 9, 7, 8


@dataclass(frozen=True)
class Entry:
    """A key with its values."""

    key: bytes  # four characters
    type: str  # a character
    size: int  # bytes of a sample
    count: int  # samples
    content: bytes


@dataclass(frozen=True, eq=False)
class Samples:
    """Samples of a payload, evenly spread over its time; NaN where there is none."""

    places: Array  # (N, 3) degrees north, degrees east, metres; the altitude may be NaN
    gravity: Array  # (M, 3) directions of up in the axes of the picture: x right, y down, z forward
    acceleration: Array  # (K, 3) the same by an accelerometer, which also feels each step
    shutter: Array  # (S, 1) seconds of exposure
    sensitivity: Array  # (I, 1) ISO


def parse_payload(payload: bytes) -> Samples:
    """The samples of a payload; what is damaged or unknown is left out."""
    found = tuple([np.zeros((0, columns))] for columns in (3, 3, 3, 1, 1))
    for device in entries(payload):
        for stream in entries(device.content) if device.type == _NESTED else ():
            if stream.type == _NESTED:
                by_key = {entry.key: entry for entry in entries(stream.content)}
                parts = (
                    _places(by_key),
                    -_values(by_key, b"GRAV", 3),
                    _acceleration(by_key),
                    _values(by_key, b"SHUT", 1),
                    _values(by_key, b"ISOE", 1),
                )
                for series, part in zip(found, parts, strict=True):
                    series.append(part)
    return Samples(*(np.concatenate(series) for series in found))


def entries(data: bytes) -> Iterator[Entry]:
    """The entries of a payload, or in a nested entry, up to the first that is damaged."""
    at = 0
    while at + 8 <= len(data):
        key, kind, size, count = struct.unpack(">4scBH", data[at : at + 8])
        length = size * count
        if at + 8 + length > len(data) or key == bytes(4):
            return
        yield Entry(key, kind.decode("latin1"), size, count, data[at + 8 : at + 8 + length])
        at += 8 + (length + 3) // 4 * 4


def _places(stream: dict[bytes, Entry]) -> Array:
    """(N, 3) of a stream of GPS."""
    if b"GPS9" in stream:  # and 2D and 3D speed, days, seconds, DOP, fix
        values = _values(stream, b"GPS9", _GPS9_FIELDS)
        values[values[:, _GPS9_FIX] == 2, 2] = np.nan
        good = (values[:, _GPS9_FIX] >= 2) & (values[:, _GPS9_DOP] * 100 < _POOR)
        return np.asarray(values[good, :3])
    values = _values(stream, b"GPS5", _GPS5_FIELDS)[:, :3]  # and 2D and 3D speed
    fix, dilution = _number(stream, b"GPSF", 3), _number(stream, b"GPSP", 0)
    if fix == 2:
        values[:, 2] = np.nan
    return values if fix >= 2 and dilution < _POOR else np.full_like(values, np.nan)


def _acceleration(stream: dict[bytes, Entry]) -> Array:
    """(K, 3) of a stream of the accelerometer."""
    order = stream[b"ORIN"].content.decode("latin1") if b"ORIN" in stream else "ZXY"
    values = _values(stream, b"ACCL", 3)
    if sorted(order.upper()) != ["X", "Y", "Z"]:
        return np.zeros((0, 3))
    x, y, z = (
        values[:, column] * (1 if axis.isupper() else -1)
        for axis, column in sorted(zip(order, range(3), strict=True), key=lambda it: it[0].upper())
    )
    return np.stack([x, -z, y], axis=1)


def _number(stream: dict[bytes, Entry], key: bytes, default: int) -> int:
    """The one number of an entry."""
    entry = stream.get(key)
    if entry is None or entry.type not in ("L", "S", "B") or len(entry.content) < _size(entry.type):
        return default
    return int(np.frombuffer(entry.content, _TYPES[entry.type], 1)[0])


def _values(stream: dict[bytes, Entry], key: bytes, fields: int) -> Array:
    """(N, fields) the scaled values of an entry; none if it is missing, or not as expected."""
    none, entry = np.zeros((0, fields)), stream.get(key)
    if entry is None:
        return none
    types = entry.type * (entry.size // _size(entry.type))
    if entry.type == _COMPLEX:
        types = stream[b"TYPE"].content.decode("latin1") if b"TYPE" in stream else ""
    kinds = [_TYPES.get(it) for it in types]
    if len(kinds) != fields or None in kinds:
        return none
    record = np.dtype([(str(n), kind) for n, kind in enumerate(kinds)])
    if record.itemsize != entry.size:
        return none
    rows = np.frombuffer(entry.content, record)
    values = np.stack([rows[str(n)].astype(np.float64) for n in range(fields)], axis=1)
    scale = _scale(stream)
    if len(scale) not in (1, fields) or not np.all(scale):
        return none
    with np.errstate(all="ignore"):  # what is not finite is left out later
        return np.asarray(values / scale)


def _scale(stream: dict[bytes, Entry]) -> Array:
    """(1,) or (fields,) divisors."""
    entry = stream.get(b"SCAL")
    if entry is None:
        return np.ones(1)
    if entry.type not in _TYPES or len(entry.content) % _size(entry.type):
        return np.zeros(0)
    return np.frombuffer(entry.content, _TYPES[entry.type]).astype(np.float64)


def _size(kind: str) -> int:
    """Bytes of a value; 1 of an unknown type."""
    return np.dtype(_TYPES.get(kind, "u1")).itemsize
