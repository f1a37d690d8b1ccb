"""Writes videos as cameras do: without loss, in any codec and container, with metadata and telemetry."""

import struct
from collections.abc import Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
from numpy.typing import NDArray

WIDTH, HEIGHT = 512, 256
BLOCK = 32  # pixels of one colour, so that colours at half the resolution are exact inside of it

_COLOURS = {"bt709": 1, "bt601": 6, "bt2020": 9}  # of AVColorSpace
_RANGES = {"limited": 1, "full": 2}


@dataclass(frozen=True)
class Encoding:
    """A codec that loses nothing."""

    codec: str
    pixels: str  # FFmpeg's name of the format
    options: dict[str, str] = field(default_factory=dict)

    @property
    def bits(self) -> int:
        """Of a sample."""
        return 10 if "10" in self.pixels else 8


H264 = Encoding("libx264", "yuv420p", {"qp": "0"})
H265 = Encoding("libx265", "yuv420p", {"x265-params": "lossless=1:log-level=none"})
H265_10 = Encoding("libx265", "yuv420p10le", {"x265-params": "lossless=1:log-level=none"})
VP9 = Encoding("libvpx-vp9", "yuv420p", {"lossless": "1", "cpu-used": "8"})

SPHERICAL = bytes.fromhex("ffcc8263f8554a938814587a02521fdd")  # of the box with XML

Planes = tuple[NDArray[np.uint16], NDArray[np.uint16], NDArray[np.uint16]]  # Y (H, W), Cb and Cr half of it


def known_frames(count: int, bits: int = 8, size: tuple[int, int] = (WIDTH, HEIGHT)) -> list[Planes]:
    """Frames of random colours in blocks, within limited range, each different."""
    random = np.random.default_rng(7)
    width, height = size
    shape = (height // BLOCK, width // BLOCK)
    frames = []
    for _ in range(count):
        values = [random.integers(40, 200, shape), *random.integers(100, 156, (2, *shape))]
        blocks = [np.asarray(it << (bits - 8), np.uint16) for it in values]
        sides = (BLOCK, BLOCK // 2, BLOCK // 2)
        luma, blue, red = (
            it.repeat(n, axis=0).repeat(n, axis=1) for it, n in zip(blocks, sides, strict=True)
        )
        frames.append((luma, blue, red))
    return frames


def write_clip(
    path: Path,
    frames: Sequence[Planes],
    encoding: Encoding = H264,
    *,
    times: Sequence[int] | None = None,
    colours: str | None = "bt709",
    range_: str | None = "limited",
    transfer: int | None = None,
    container: str | None = None,
    lenses: int = 1,
) -> Path:
    """Frames, all of one size, as a video in the container of the suffix, unless another is given.

    Args: times, N ascending milliseconds, or 30 frames per second; colours, range_, the tags, None = none;
    transfer, by its number in H.273; lenses, tracks with these frames.
    """
    height, width = frames[0][0].shape
    with av.open(str(path), "w", format=container) as file:
        streams = [file.add_stream(encoding.codec, rate=30, options=encoding.options) for _ in range(lenses)]
        for stream in streams:
            assert isinstance(stream, av.VideoStream)
            stream.width, stream.height, stream.pix_fmt = width, height, encoding.pixels
            context = stream.codec_context
            context.time_base = Fraction(1, 90_000)
            if colours is not None:
                context.colorspace = _COLOURS[colours]
            if range_ is not None:
                context.color_range = _RANGES[range_]
            if transfer is not None:
                context.color_trc = transfer
        for stream in streams:
            assert isinstance(stream, av.VideoStream)
            for number, planes in enumerate(frames):
                frame = _frame(planes, encoding.pixels)
                frame.pts = number * 3_000 if times is None else times[number] * 90
                frame.time_base = Fraction(1, 90_000)
                file.mux(stream.encode(frame))
            file.mux(stream.encode(None))
    return path


def _frame(planes: Planes, pixels: str) -> av.VideoFrame:
    height, width = planes[0].shape
    frame = av.VideoFrame(width, height, pixels)
    for plane, values in zip(frame.planes, planes, strict=True):
        kind = np.uint16 if "10" in pixels else np.uint8
        rows = np.zeros((plane.height, plane.line_size // kind().itemsize), kind)
        rows[:, : plane.width] = values
        plane.update(rows.tobytes())
    return frame


def box(kind: bytes, *content: bytes) -> bytes:
    """A box of MP4."""
    inner = b"".join(content)
    return struct.pack(">I4s", 8 + len(inner), kind) + inner


def full(kind: bytes, *content: bytes) -> bytes:
    """A box with version 0 and no flags."""
    return box(kind, bytes(4), *content)


def insert(path: Path, where: str, extra: bytes) -> Path:
    """Adds boxes at the end of the first box at `where`, such as "moov/trak"; "…/stsd/*" is its first entry.

    The movie box must be the last one, as FFmpeg writes it, so that nothing moves that others point at.
    """
    data = bytearray(path.read_bytes())
    start, end = 0, len(data)
    sizes = list[int]()
    for kind in where.encode().split(b"/"):
        at = start + (8 if sizes and data[sizes[-1] + 4 : sizes[-1] + 8] == b"stsd" else 0)
        while kind not in (b"*", bytes(data[at + 4 : at + 8])):
            at += int.from_bytes(data[at : at + 4], "big")
            assert at < end, where
        sizes.append(at)
        start, end = at + 8, at + int.from_bytes(data[at : at + 4], "big")
    data[end:end] = extra
    for at in sizes:
        data[at : at + 4] = (int.from_bytes(data[at : at + 4], "big") + len(extra)).to_bytes(4, "big")
    path.write_bytes(data)
    return path


def add_spherical(
    path: Path,
    projection: bytes | None = None,
    *,
    stereo: int | None = None,
    pose: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> Path:
    """Google's metadata, version 2; `projection` is the box that describes it: by default, all of it."""
    projection = full(b"equi", bytes(16)) if projection is None else projection
    degrees = struct.pack(">3i", *(round(angle * 2**16) for angle in pose))
    sv3d = box(b"sv3d", full(b"svhd", b"test\0"), box(b"proj", full(b"prhd", degrees), projection))
    st3d = b"" if stereo is None else full(b"st3d", bytes([stereo]))
    return insert(path, "moov/trak/mdia/minf/stbl/stsd/*", st3d + sv3d)


def equirectangular(left: float, top: float, right: float, bottom: float) -> bytes:
    """The box of a cropped panorama, by the fractions that are missing."""
    return full(b"equi", struct.pack(">4I", *(round(it * 2**32) for it in (top, bottom, left, right))))


def add_spherical_xml(path: Path, **values: object) -> Path:
    """Google's metadata, version 1, with more elements or others."""
    known = {"Spherical": "true", "Stitched": "true", "ProjectionType": "equirectangular"} | values
    elements = "".join(f"<GSpherical:{name}>{value}</GSpherical:{name}>" for name, value in known.items())
    text = (
        '<?xml version="1.0"?><rdf:SphericalVideo xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#" '
        f'xmlns:GSpherical="http://ns.google.com/videos/1.0/spherical/">{elements}</rdf:SphericalVideo>'
    )
    return insert(path, "moov/trak", box(b"uuid", SPHERICAL, text.encode()))


def as_matroska(path: Path, later: float = 0.0) -> Path:
    """A copy of a video and its metadata in Matroska's elements, by FFmpeg, shown `later` seconds later."""
    target = path.with_suffix(".mkv")
    with av.open(str(path)) as source, av.open(str(target), "w") as file:
        stream = file.add_stream_from_template(source.streams.video[0])
        for packet in source.demux(video=0):
            if packet.dts is not None and packet.pts is not None:
                shift = round(later / packet.time_base)
                packet.dts, packet.pts = packet.dts + shift, packet.pts + shift
                packet.stream = stream
                file.mux(packet)
    return target


def turn(path: Path, matrix: tuple[int, int, int, int]) -> Path:
    """Sets a, b, c, d of the display matrix of the first track."""
    data = bytearray(path.read_bytes())
    at = data.index(b"tkhd") + 4 + 40
    a, b, c, d = (value * 2**16 for value in matrix)
    data[at : at + 36] = struct.pack(">9i", a, b, 0, c, d, 0, 0, 0, 2**30)
    path.write_bytes(data)
    return path


def add_track(path: Path, kind: bytes, samples: Sequence[tuple[int, bytes]], duration: int) -> Path:
    """A track of metadata in an MP4, such as camm and gpmd: `kind` of its sample entry.

    Args: samples, when each begins, in milliseconds, ascending from 0, and its bytes; duration of all.
    """
    starts = [time for time, _ in samples]
    assert starts[0] == 0
    spans = np.diff([*starts, duration])
    payload = b"".join(data for _, data in samples)

    def table(offset: int) -> bytes:
        ends = np.cumsum([len(data) for _, data in samples])
        offsets = [offset + int(end) - len(data) for end, (_, data) in zip(ends, samples, strict=True)]
        count = struct.pack(">I", len(samples))
        return box(
            b"stbl",
            full(b"stsd", struct.pack(">I", 1), box(kind, bytes(6), b"\0\1")),
            full(b"stts", count, *(struct.pack(">2I", 1, int(span)) for span in spans)),
            full(b"stsc", struct.pack(">4I", 1, 1, 1, 1)),
            full(b"stsz", bytes(4), count, *(struct.pack(">I", len(data)) for _, data in samples)),
            full(b"stco", count, *(struct.pack(">I", it) for it in offsets)),
        )

    def track(offset: int) -> bytes:
        identity = struct.pack(">9i", 2**16, 0, 0, 0, 2**16, 0, 0, 0, 2**30)
        ticks = struct.pack(">I", duration)
        return box(
            b"trak",
            box(
                b"tkhd",
                b"\0\0\0\7",
                bytes(8),
                struct.pack(">I", 9),
                bytes(4),
                ticks,
                bytes(16),
                identity,
                bytes(8),
            ),
            box(
                b"mdia",
                full(b"mdhd", bytes(8), struct.pack(">I", 1_000), ticks, bytes(4)),
                full(b"hdlr", bytes(4), b"meta", bytes(12), b"telemetry\0"),
                box(
                    b"minf",
                    full(b"nmhd"),
                    box(b"dinf", full(b"dref", struct.pack(">I", 1), box(b"url ", b"\0\0\0\1"))),
                    table(offset),
                ),
            ),
        )

    insert(path, "moov", track(path.stat().st_size + len(track(0)) + 8))
    path.write_bytes(path.read_bytes() + box(b"mdat", payload))
    return path
