"""What a video says of its projection: Google's spherical metadata, version 1 and 2.

Sources: github.com/google/spatial-media, docs/spherical-video-rfc.md (an XML document in a `uuid` box of the
track) and docs/spherical-video-v2-rfc.md (the boxes st3d and sv3d in the track's sample entry), which takes
precedence. InitialView… of version 1 says where a viewer looks first; only the pose of version 2 turns the
picture.
"""

import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Literal
from xml.etree.ElementTree import Element

from defusedxml.common import DefusedXmlException
from defusedxml.ElementTree import ParseError, fromstring

from panolog.prepare.video.boxes import Box, BoxReader

Stereo = Literal["mono", "top-bottom", "left-right", "right-left", "custom"]
Bounds = tuple[float, float, float, float]

_UUID = bytes.fromhex("ffcc8263f8554a938814587a02521fdd")
_NAMESPACE = "{http://ns.google.com/videos/1.0/spherical/}"
_STEREO: tuple[Stereo, ...] = ("mono", "top-bottom", "left-right", "custom", "right-left")  # by stereo_mode
_PROJECTIONS = {b"equi": "equirectangular", b"cbmp": "cubemap", b"mshp": "mesh"}
_FFMPEG_PROJECTIONS = {  # 2 is the first one with bounds
    0: "equirectangular",
    1: "cubemap",
    2: "equirectangular",
    3: "half-equirectangular",
    4: "rectilinear",
    5: "fisheye",
}
_FFMPEG_STEREO: dict[tuple[int, int], Stereo] = {  # by type, and whether the right eye is first
    (0, 0): "mono",
    (1, 0): "left-right",
    (1, 1): "right-left",
    (2, 0): "top-bottom",
}
_DIGITS = 10  # of a number of pixels in XML


@dataclass(frozen=True)
class Spherical:
    """How the frames of a video lie on the sphere."""

    projection: str = "equirectangular"
    stereo: Stereo = "mono"
    bounds: Bounds = (0.0, 0.0, 0.0, 0.0)  # of the whole panorama: left, top, right, bottom that are missing
    pitch: float = 0.0  # degrees by which the middle of the picture is above the horizon
    roll: float = 0.0  # degrees by which its right side is lower, as in `Attitude`


def read_spherical(path: Path) -> Spherical | None:
    """The metadata of the first video track that has some; None without, also if it is damaged.

    Raises OSError: the file cannot be read.
    """
    with path.open("rb") as file:
        reader = BoxReader(file, path.stat().st_size)
        for track in reader.find(reader.file, "moov/trak"):
            found = _version_2(reader, track) or _version_1(reader, track)
            if found is not None:
                return found
    return None


def spherical_of(mapping: bytes | None, stereo: bytes | None) -> Spherical | None:
    """The metadata of other containers, such as Matroska's, as FFmpeg hands it over.

    Args:
        mapping: its structure AVSphericalMapping, of native integers: projection, yaw, pitch and roll in
            16.16, and left, top, right and bottom bounds in 0.32; None if there is none.
        stereo: its structure AVStereo3D, which begins with the type and flags.
    """
    if mapping is None or len(mapping) < 32:
        return None
    kind, _, pitch, roll, *bounds = struct.unpack("=I3i4I", mapping[:32])
    layout: Stereo = "mono"
    if stereo is not None and len(stereo) >= 8:
        how, swapped = struct.unpack("=2I", stereo[:8])
        layout = _FFMPEG_STEREO.get((how, swapped & 1), "custom")
    left, top, right, bottom = (value / 2**32 for value in bounds)
    projection = _FFMPEG_PROJECTIONS.get(kind, f"number {kind}")
    return Spherical(projection, layout, (left, top, right, bottom), pitch / 2**16, -roll / 2**16)


def _version_2(reader: BoxReader, track: Box) -> Spherical | None:
    """The metadata in the sample entries of a track."""
    for stsd in reader.find(track, "mdia/minf/stbl/stsd"):
        for entry in reader.entries(stsd):
            boxes = {box.kind: box for box in reader.children(entry)}
            if b"sv3d" in boxes:
                stereo: Stereo = "mono"
                if b"st3d" in boxes:
                    mode = reader.read(boxes[b"st3d"])[4:5]  # after version and flags
                    stereo = _STEREO[mode[0]] if mode and mode[0] < len(_STEREO) else "custom"
                return _projection(reader, boxes[b"sv3d"], stereo)
    return None


def _projection(reader: BoxReader, sv3d: Box, stereo: Stereo) -> Spherical | None:
    """The content of a box sv3d."""
    for proj in reader.find(sv3d, "proj"):
        boxes = {box.kind: reader.read(box) for box in reader.children(proj)}
        header = boxes.pop(b"prhd", b"")
        pitch = roll = 0.0
        if len(header) >= 16:  # version and flags, then yaw, pitch and roll in 16.16
            _, pitch, roll = (value / 2**16 for value in struct.unpack(">3i", header[4:16]))
        name = next((kind for kind in boxes if kind in _PROJECTIONS), next(iter(boxes), None))
        if name is None:
            return None
        bounds = (0.0, 0.0, 0.0, 0.0)
        if name == b"equi" and len(boxes[name]) >= 20:  # version and flags, then four numbers in 0.32
            top, bottom, left, right = (value / 2**32 for value in struct.unpack(">4I", boxes[name][4:20]))
            bounds = (left, top, right, bottom)
        # Clockwise about the forward vector, as yaw and pitch are counter-clockwise about up and right, lifts
        # the right side: the rotation is Ry(yaw) Rx(pitch) Rz(roll) with x right, y up, z back.
        return Spherical(_PROJECTIONS.get(name, _printable(name)), stereo, bounds, pitch, -roll)
    return None


def _version_1(reader: BoxReader, track: Box) -> Spherical | None:
    """The metadata in the XML of a track."""
    for box in reader.find(track, "uuid"):
        content = reader.read(box)
        if content.startswith(_UUID):
            try:
                root = fromstring(content[len(_UUID) :].strip(b"\0 \t\r\n"), forbid_dtd=True)
            except (ParseError, DefusedXmlException, ValueError):
                return None
            values = _values(root)
            if values.get("Spherical", "").lower() != "true":
                return None
            mode = values.get("StereoMode", "mono").lower()
            stereo: Stereo = next((it for it in _STEREO if it == mode), "custom")
            projection = values.get("ProjectionType", "equirectangular").encode()[:32]
            return Spherical(_printable(projection).lower(), stereo, _cropped(values))
    return None


def _values(root: Element) -> dict[str, str]:
    """The text of each element of the namespace, by its name."""
    return {
        element.tag.removeprefix(_NAMESPACE): (element.text or "").strip()
        for element in root.iter()
        if isinstance(element.tag, str) and element.tag.startswith(_NAMESPACE)
    }


def _cropped(values: dict[str, str]) -> Bounds:
    """The bounds in pixels; none if some are missing or contradict each other, as in the RFC's example."""
    bounds = []
    for side, extent in (("Left", "Width"), ("Top", "Height")):
        texts = [values.get(f"CroppedArea{side}Pixels", "0")]
        texts += [
            values.get(name, "") for name in (f"CroppedAreaImage{extent}Pixels", f"FullPano{extent}Pixels")
        ]
        if not all(text.isascii() and text.isdigit() and len(text) <= _DIGITS for text in texts):
            return (0.0, 0.0, 0.0, 0.0)
        before, image, full = map(int, texts)
        if not (image > 0 and before + image <= full):
            return (0.0, 0.0, 0.0, 0.0)
        bounds.append((before / full, (full - before - image) / full))
    (left, right), (top, bottom) = bounds
    return (left, top, right, bottom)


def _printable(name: bytes) -> str:
    """A name of the file, for a message."""
    return "".join(chr(it) if 32 < it < 127 else "?" for it in name)
