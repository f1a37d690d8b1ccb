"""A table of poses: a header, and a line for each panorama with its name, place and attitude.

The header says what columns mean, in any order and in any case; others are left out. Cells are separated by
commas, semicolons, tabs or blanks. Names are `name`, `image`, `file` or `label`; `x`, `y`, `z` (or `easting`,
`northing`, `height`) is where the camera is. Of three ways to give the attitude there must be one:

- `qw`, `qx`, `qy`, `qz`: camera-to-world, camera x right, y down, z forward, as in TUM's trajectories.
- `omega`, `phi`, `kappa`: camera-to-world R = Rx(ω) Ry(φ) Rz(κ), camera x right, y up, z backward. Source:
  doc.arcgis.com/en/reality-studio, "Orientation data coordinate system conventions"; Agisoft's forum, topic
  12982, for the axes.
- `yaw` or `heading`, `pitch`, `roll`, where x is east, y north and z up. Heading is clockwise from north. A
  pitch near 0 is that of a level camera: then the angles are GPano's, see `prepare/world/exif.py`. A pitch
  near 90 is that of a level camera for programs whose cameras look down at 0: camera-to-world
  R = Rz(-yaw) Rx(pitch) Ry(roll), camera x right, y up, z backward (Agisoft's forum, topic 12200, has values
  of Metashape's `ypr2mat`).

Angles are in degrees, or as the header says: `omega_rad`, `omega [rad]`. Pixel centres are assumed at +0.5.
"""

import codecs
import csv
import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from panolog.prepare.importers.interface import (
    FLIP_YZ,
    Array,
    ImportedScene,
    ImportSource,
    find_panorama,
    read_head,
)
from panolog.scene.errors import SceneError
from panolog.scene.write import PosedImage

_SUFFIXES = (".csv", ".txt", ".tsv")
_UTF_16 = (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)
_ALIASES = {
    "name": ("name", "image", "imagename", "file", "filename", "label", "photo"),
    "x": ("x", "easting", "east"),
    "y": ("y", "northing", "north"),
    "z": ("z", "height", "alt", "altitude", "elevation", "up"),
    "yaw": ("yaw", "heading"),
    **{name: (name,) for name in ("qw", "qx", "qy", "qz", "omega", "phi", "kappa", "pitch", "roll")},
}
_CANONICAL = {alias: name for name, aliases in _ALIASES.items() for alias in aliases}
_PLACE = ("x", "y", "z")
_ATTITUDES = (("qw", "qx", "qy", "qz"), ("omega", "phi", "kappa"), ("yaw", "pitch", "roll"))
_QUATERNION = ("q0", "q1", "q2", "q3", "q4")
_UNCLEAR = {
    _QUATERNION: "which of its numbers is the real part is unknown: name them qw, qx, qy, qz",
    ("tx", "ty", "tz"): "a translation is not where the camera is: give that as x, y, z",
    ("lat", "latitude", "lon", "longitude"): "project the angles on the earth to metres: x, y, z",
}
_WORDS = {word for words in _UNCLEAR for word in words}
_FEWEST = 4  # words of a header that are known: a name and a place
_UNIT = re.compile(r"[ _]*[(\[]?(deg|degrees|°|rad|radians|m|metres|meters)?[)\]]?$")
_LEVEL = 45.0  # degrees of pitch up to which a camera is level, and from which it looks down at 0
_LARGEST = 2**28  # bytes


def detect(source: ImportSource) -> bool:
    """Whether this is a table with such a header."""
    path = source.path
    if not (path.is_file() and path.suffix.lower() in _SUFFIXES):
        return False
    lines = _text(read_head(path), "replace").splitlines()
    return _header(lines) is not None


def read(source: ImportSource) -> ImportedScene:
    """Reads the scene; see `interface`."""
    path = source.path
    rows, head, cells = _cells(path, source.memory)
    columns, units = _columns(head)
    attitude = _attitude(path, head, columns)
    numbers = np.array(
        [
            [_number(f"{path}: line {row}: {name}", line[columns[name]]) for name in (*_PLACE, *attitude)]
            for row, line in zip(rows, cells, strict=True)
        ]
    ).reshape(len(rows), -1)
    angles, note = numbers[:, 3:], ""
    if attitude[0] != "qw":
        angles = _degrees(path, attitude, angles, {units[name] for name in attitude})
    if attitude[0] == "yaw":
        note = f"{path.name}: x is taken as east, y as north, z as up"
    rotations = _rotations(path, rows, attitude, angles)
    folders = source.image_folders("images", "imgs")
    images = []
    for row, line, place, rotation in zip(rows, cells, numbers[:, :3], rotations, strict=True):
        found = find_panorama(f"{path}: line {row}", folders, line[columns["name"]].strip())
        images.append(PosedImage(*found, rotation.T, -rotation.T @ place))
    return ImportedScene(images, *source.cloud("points.ply"), notes=[note] if note else [])


def _cells(path: Path, memory: int) -> tuple[list[int], list[str], list[list[str]]]:
    """The number of each line behind the header, the header, and the cells of these lines."""
    if path.stat().st_size > min(_LARGEST, memory // 8):
        raise SceneError(f"{path}: is too large to be a table of poses")
    try:
        lines = _text(path.read_bytes(), "strict").splitlines()
    except UnicodeDecodeError as error:
        raise SceneError(f"{path}: is not UTF-8; save it as UTF-8") from error
    found = _header(lines)
    if found is None:
        raise SceneError(f"{path}: has no header with name, x, y, z and an attitude")
    at, head = found
    rows = [row for row in range(at + 1, len(lines)) if lines[row].strip() and lines[row].lstrip()[0] != "#"]
    cells = [_split(lines[row], _separator(lines[at])) for row in rows]
    for row, line in zip(rows, cells, strict=True):
        if len(line) != len(head):
            raise SceneError(f"{path}: line {row + 1}: has {len(line)} cells; the header has {len(head)}")
    return [row + 1 for row in rows], head, cells


def _text(content: bytes, errors: str) -> str:
    """UTF-8, or UTF-16 where the file begins as "Unicode text" of spreadsheets does."""
    return content.decode("utf-16" if content.startswith(_UTF_16) else "utf-8-sig", errors)


def _header(lines: Sequence[str]) -> tuple[int, list[str]] | None:
    """The row and the cells of the header: one of the lines that begin with #, or the first other one."""
    for row, line in enumerate(lines):
        text = line.strip().lstrip("#").strip()
        head = _split(text, _separator(text)) if text else []
        words = _WORDS.intersection(cell.strip().lower() for cell in head) | _columns(head)[0].keys()
        if "name" in words and len(words) >= _FEWEST:
            return row, head
        if text and not line.strip().startswith("#"):
            return None
    return None


def _separator(line: str) -> str:
    return next((it for it in "\t;," if it in line), " ")


def _split(line: str, separator: str) -> list[str]:
    """The cells of a line; with semicolons a comma is that of decimals."""
    if separator == " ":
        return line.split()
    cells = next(csv.reader([line], delimiter=separator), [])
    return [cell.strip().replace(",", ".") if separator == ";" else cell.strip() for cell in cells]


def _columns(head: Sequence[str]) -> tuple[dict[str, int], dict[str, str]]:
    """The column and the unit of each known name; -1 where several columns have it."""
    columns, units = dict[str, int](), dict[str, str]()
    for column, cell in enumerate(head):
        text = cell.strip().lower()
        found = _UNIT.search(text)
        bare = text[: found.start()] if found else text
        name = _CANONICAL.get(text) or _CANONICAL.get(bare.replace("_", "").replace(" ", ""))
        if name is not None:
            columns[name] = -1 if name in columns else column
            units[name] = ((found[1] if found else "") or "")[:3]
    return columns, units


def _attitude(path: Path, head: Sequence[str], columns: dict[str, int]) -> tuple[str, ...]:
    """The columns of the attitude. Raises SceneError if the header does not decide."""
    where = f"{path}: its header"
    for names, why in _UNCLEAR.items():
        if unclear := [cell.strip() for cell in head if cell.strip().lower() in names]:
            raise SceneError(f"{where} has {', '.join(unclear)}: {why}")
    if missing := [name for name in _PLACE if name not in columns]:
        raise SceneError(f"{where} lacks {', '.join(missing)}: where each camera is")
    if twice := [name for name, column in columns.items() if column < 0]:
        raise SceneError(f"{where} has several columns for {', '.join(twice)}; leave one of each")
    begun = [names for names in _ATTITUDES if set(names) & columns.keys()]
    shown = [", ".join(names) for names in begun or _ATTITUDES]
    if len(begun) > 1:
        raise SceneError(f"{where} has several attitudes ({'; '.join(shown)}), which may differ; leave one")
    if not begun:
        raise SceneError(
            f"{where} has no attitude; add {'; or '.join(shown)}; places alone are a `--trajectory` of "
            "`panolog scene sfm`"
        )
    if missing := [name for name in begun[0] if name not in columns]:
        raise SceneError(f"{where} lacks {', '.join(missing)} of {shown[0]}")
    return begun[0]


def _number(where: str, text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = np.nan
    if not abs(value) < 1e12:
        raise SceneError(f"{where}: {text[:40]!r} is no number of a pose")
    return value


def _degrees(path: Path, names: Sequence[str], angles: Array, units: set[str]) -> Array:
    """(N, 3) angles in degrees. Raises SceneError if their unit is not known."""
    if len(units) > 1:
        raise SceneError(f"{path}: its header gives {', '.join(names)} in different units; give one")
    unit = units.pop()
    if unit == "rad":
        return np.rad2deg(angles)
    if not unit and np.abs(angles).max(initial=0) <= 2 * np.pi:
        raise SceneError(
            f"{path}: {', '.join(names)} may be degrees or radians, as none is above 2 pi; name them "
            f"{names[0]}_deg or {names[0]}_rad, and the others alike"
        )
    return angles


def _rotations(path: Path, rows: Sequence[int], attitude: Sequence[str], values: Array) -> Array:
    """(N, 3, 3) camera-to-world, camera x right, y down, z forward."""
    if attitude[0] == "qw":
        lengths = np.linalg.norm(values, axis=1)
        for row, length in zip(rows, lengths, strict=True):
            if not abs(length - 1) < 0.01:
                raise SceneError(f"{path}: line {row}: its quaternion has length {length:.3g}, not 1")
        return np.asarray(Rotation.from_quat(values[:, [1, 2, 3, 0]]).as_matrix())
    if attitude[0] == "omega":
        return np.asarray(Rotation.from_euler("XYZ", values, degrees=True).as_matrix() @ FLIP_YZ)
    yaw, pitch, roll = values.T
    tilt = np.abs(pitch)
    if (tilt < _LEVEL).all():
        level = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])  # a camera that looks north
        north = Rotation.from_euler("Z", -yaw[:, None], degrees=True).as_matrix() @ level
        turned = Rotation.from_euler("XZ", np.column_stack([pitch, roll]), degrees=True).as_matrix()
        return np.asarray(north @ turned)
    if (np.abs(tilt - 90) < _LEVEL).all():
        angles = np.column_stack([-yaw, pitch, roll])
        return np.asarray(Rotation.from_euler("ZXY", angles, degrees=True).as_matrix() @ FLIP_YZ)
    raise SceneError(
        f"{path}: pitch is that of level cameras neither by 0 nor by 90 degrees ({tilt.min():.0f} to "
        f"{tilt.max():.0f}), so its convention is unknown; give qw, qx, qy, qz or omega, phi, kappa"
    )
