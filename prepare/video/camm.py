"""Google's telemetry, CAMM: GPS and gravity in the packets of the track camm.

Source: developers.google.com/streetview/publish/camm-spec: little-endian, two bytes that are 0, two of the
type, and then by type. The axes of the accelerometer are the camera's by recommendation only; as Android's
they are x right, y up, z back. The orientation of type 0 is in a world that the application chooses, so it
does not say what is up.
"""

import struct

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_LENGTHS = {0: 12, 1: 8, 2: 12, 3: 12, 4: 12, 5: 24, 6: 56, 7: 12}  # bytes after the head, by type
_ACCELERATION, _PLACE, _GPS = 3, 5, 6


def is_packet(packet: bytes) -> bool:
    """Whether it has the head and the length of a packet."""
    if len(packet) < 4:
        return False
    reserved, kind = struct.unpack("<2H", packet[:4])
    return reserved == 0 and len(packet) == 4 + _LENGTHS.get(kind, -4)


def place(packet: bytes) -> Array | None:
    """(3,) degrees north, degrees east and metres of a packet with GPS; the altitude may be NaN."""
    kind = struct.unpack("<H", packet[2:4])[0]
    if kind == _PLACE:
        return np.array(struct.unpack("<3d", packet[4:28]))
    if kind == _GPS:
        fix, latitude, longitude, altitude = struct.unpack("<i2df", packet[12:36])
        if fix >= 2:  # 2 is without an altitude, 3 with one
            return np.array([latitude, longitude, np.nan if fix == 2 else altitude])
    return None


def has_quality(packet: bytes) -> bool:
    """Whether a packet has GPS with its quality."""
    return packet[2] == _GPS


def acceleration(packet: bytes) -> Array | None:
    """(3,) the direction of up in the axes of the picture, x right, y down, z forward, but for movements."""
    if packet[2] != _ACCELERATION:
        return None
    x, y, z = struct.unpack("<3f", packet[4:16])
    return np.array([x, -y, -z])
