"""Telemetry as cameras write it: payloads of GPMF and packets of CAMM."""

import struct
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def up_of(pitch: float, roll: float) -> Array:
    """(3,) up in the axes of the picture: x right, y down, z forward; of angles in degrees.

    A camera that looks along y with z up is lifted by `pitch`, and its right side lowered by `roll`.
    """
    p, r = np.deg2rad([pitch, roll])
    forward = np.array([0.0, np.cos(p), np.sin(p)])
    above = np.array([0.0, -np.sin(p), np.cos(p)])
    level = np.array([1.0, 0.0, 0.0])
    right = np.cos(r) * level - np.sin(r) * above
    down = np.cross(forward, right)
    return np.array([right[2], down[2], forward[2]])


def klv(key: str, kind: str, rows: Sequence[bytes]) -> bytes:
    """An entry of GPMF with samples of one size."""
    content = b"".join(rows)
    head = struct.pack(">4scBH", key.encode(), kind.encode(), len(rows[0]) if rows else 0, len(rows))
    return head + content + bytes(-len(content) % 4)


def nested(key: str, *entries: bytes) -> bytes:
    """An entry of GPMF with entries in it."""
    content = b"".join(entries)
    return struct.pack(">4sBBH", key.encode(), 0, 4, len(content) // 4) + content


def payload(*streams: bytes) -> bytes:
    """A payload of GPMF, from entries of STRM."""
    device = klv("DVID", "L", [struct.pack(">I", 1)]), klv("DVNM", "c", [b"C", b"a", b"m"])
    return nested("DEVC", *device, *streams)


def gps5(places: Array, *, fix: int = 3, dilution: int = 150) -> bytes:
    """A stream of places (N, 3): degrees north, degrees east, metres."""
    scale = (10_000_000, 10_000_000, 1_000, 1_000, 100)
    rows = np.hstack([places, np.zeros((len(places), 2))])
    return nested(
        "STRM",
        klv("STNM", "c", [b"GPS (Lat., Long., Alt., 2D speed, 3D speed)"]),
        klv("GPSF", "L", [struct.pack(">I", fix)]),
        klv("GPSU", "U", [b"240501120000.000"]),
        klv("GPSP", "S", [struct.pack(">H", dilution)]),
        klv("SCAL", "l", [struct.pack(">i", it) for it in scale]),
        klv("GPS5", "l", [struct.pack(">5i", *np.rint(row * scale).astype(int)) for row in rows]),
    )


def gps9(places: Array, *, fix: int = 3, dilution: int = 150) -> bytes:
    """The same as newer cameras write it."""
    scale = (10_000_000, 10_000_000, 1_000, 1_000, 100, 1, 1_000, 100, 1)
    rest = np.array([0, 0, 8_887, 43_200, dilution / 100, fix])
    rows = [np.rint(np.concatenate([place, rest]) * scale).astype(int) for place in places]
    return nested(
        "STRM",
        klv("TYPE", "c", [bytes([it]) for it in b"lllllllSS"]),
        klv("SCAL", "l", [struct.pack(">i", it) for it in scale]),
        klv("GPS9", "?", [struct.pack(">7i2H", *row) for row in rows]),
    )


def grav(ups: Array) -> bytes:
    """A stream of gravity, the opposite of ups (N, 3) in the axes of the picture."""
    rows = [struct.pack(">3h", *np.rint(-up * 32_767).astype(int)) for up in ups]
    return nested("STRM", klv("SCAL", "s", [struct.pack(">h", 32_767)]), klv("GRAV", "s", rows))


def accl(ups: Array, order: str | None = None) -> bytes:
    """A stream of an accelerometer whose axes are X right, Y forward, Z up, in the order of ORIN."""
    rows = []
    for right, down, forward in 9.81 * ups:
        axes = {"X": right, "Y": forward, "Z": -down}
        values = [axes[it.upper()] * (1 if it.isupper() else -1) for it in order or "ZXY"]
        rows.append(struct.pack(">3h", *np.rint(np.array(values) * 417).astype(int)))
    orientation = () if order is None else (klv("ORIN", "c", [bytes([it]) for it in order.encode()]),)
    return nested("STRM", *orientation, klv("SCAL", "s", [struct.pack(">h", 417)]), klv("ACCL", "s", rows))


def exposure(seconds: Sequence[float], iso: Sequence[int]) -> bytes:
    """Two streams: of the shutter and of the sensor's gain."""
    shutter = nested("STRM", klv("SHUT", "f", [struct.pack(">f", it) for it in seconds]))
    return shutter + nested("STRM", klv("ISOE", "S", [struct.pack(">H", it) for it in iso]))


def camm(kind: int, *values: float) -> bytes:
    """A packet of CAMM: 3 has right, up and back; 5 latitude, longitude and altitude; 6 all of them."""
    layout = {0: "3f", 2: "3f", 3: "3f", 5: "3d", 6: "di2df6f", 7: "3f"}[kind]
    return struct.pack(f"<2H{layout}", 0, kind, *values)


def camm_gps(place: Array, *, fix: int = 3) -> bytes:
    """A packet of type 6."""
    return camm(6, 1.4e9, fix, *place, 2.0, 3.0, 0.0, 0.0, 0.0, 0.5)
