"""Models in the formats of others: SOG, SPZ and compressed PLY, and PLYs that were turned for viewers."""

import zipfile
from dataclasses import replace
from pathlib import Path

from panolog.export.compressed_ply import read_compressed_ply
from panolog.export.frame import Frame
from panolog.export.sog.read import read_sog
from panolog.export.splats import Splats
from panolog.export.spz import read_spz
from panolog.scene.errors import FormatError
from panolog.scene.files import StrPath
from panolog.scene.gaussians import concatenate
from panolog.scene.ply import read_ply, write_ply

_HEAD = 4096  # bytes that say what a file is
_SPZ = (b"\x1f\x8b", b"NGSP")  # gzip, and version 4


def is_ply(path: Path) -> bool:
    """Whether a path is a PLY as trainers write it. Raises FormatError if it cannot be read."""
    head = _head(path)
    return head.startswith(b"ply") and b"element chunk" not in head


def is_spz(path: Path) -> bool:
    """Whether a path is an SPZ, whatever its name. Raises FormatError if it cannot be read."""
    return _head(path).startswith(_SPZ)


def read_model(path: Path) -> Splats:
    """The Gaussians of an SOG (a file, or its folder or meta.json), an SPZ or a compressed PLY.

    Raises FormatError if it is none of these, or damaged.
    """
    if path.is_dir() or path.name == "meta.json":
        return read_sog(path)
    head = _head(path)
    if head.startswith(b"ply"):
        return read_compressed_ply(path)
    if head.startswith(_SPZ):
        return read_spz(path)
    if zipfile.is_zipfile(path):
        return read_sog(path)
    raise FormatError(f"{path}: is not a model; PLY, compressed PLY, SOG and SPZ are read")


def convert_to_ply(path: Path, output: StrPath, frame: Frame, *, exact: bool) -> None:
    """Writes a model of `read_model` as a PLY, with the sky that is in a file next to it (`sky_of`).

    Args: frame, that of the file, which the PLY is turned back from; exact, `Gaussians.exact` where it is not
    known from a PLY.
    Raises FormatError as `read_model`; PlyError if a PLY is damaged; OSError if the PLY cannot be written.
    """
    if is_ply(path):
        found = read_ply(path)
        back = Splats.of(found).turned(frame.inverse).gaussians(exact=found.exact)
        write_ply(output, replace(back, sky=found.sky))
        return
    model = read_model(path).turned(frame.inverse).gaussians(exact=exact)
    sky = sky_of(path)
    if is_spz(path) and sky.is_file():
        apart = read_model(sky).turned(frame.inverse).gaussians(exact=exact)
        model = concatenate(model, replace(apart, sky=len(apart)))
    write_ply(output, model)


def sky_of(path: Path) -> Path:
    """Where the sky of an SPZ is, whose size the same file may not hold."""
    return path.with_name(f"{path.stem}-sky.spz")


def _head(path: Path) -> bytes:
    """The first bytes; none of a folder, which may be a SOG."""
    if path.is_dir():
        return b""
    try:
        with path.open("rb") as file:
            return file.read(_HEAD)
    except FileNotFoundError as error:
        raise FormatError(f"{path}: there is no such file") from error
    except OSError as error:
        raise FormatError(f"{path}: cannot be read: {error.strerror}") from error
