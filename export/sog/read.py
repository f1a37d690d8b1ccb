"""SOG read, versions 1 and 2: a .sog file, a folder or its meta.json, of this program or of others.

`layers` has what the numbers mean in version 2. Version 1, which PlayCanvas wrote in 2025, has no `version`:
sizes, colours, opacities (logit) and palettes are linear between bounds instead of entries of codebooks.
Files may be hostile: all sizes are compared with the number of Gaussians before memory is used, and that
number with the bytes of the files.
"""

import io
import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from panolog.export.sog.archive import Archive, Folder
from panolog.export.sog.layers import COLUMNS
from panolog.export.sog.palette import MOST as MOST_ENTRIES
from panolog.export.sog.whole_folder import INDEX, META
from panolog.export.sog.write import MOST
from panolog.export.splats import REST, Splats, quaternions
from panolog.scene.errors import FormatError
from panolog.scene.files import StrPath
from panolog.scene.pictures.headers import DAMAGE, read_header

Bytes = NDArray[np.uint8]
Floats = NDArray[np.float32]

_META_BYTES = 2**20
_LARGEST = 80.0  # of bounds in meta.json: exp of it is finite in float32
_LARGEST_ENTRY = 1e6  # of a codebook
_FREE, _DENSE = 2**20, 4  # Gaussians that any file may hold, and how many more for each of its bytes
_PADDING = 65_536  # pixels of an image besides four for each Gaussian
_MOST_PIXELS = 80_000_000  # below the size at which Pillow warns
_PIXEL_BYTES = 8  # of a compressed image, at most
_OPAQUE = 1e-6  # as splat-transform reads opacities of 0 and 1
_IDENTITY_TAG = 252  # of a quaternion whose first component is left out


@dataclass(frozen=True)
class _Meta:
    """meta.json of either version."""

    where: Path
    count: int
    files: dict[str, list[str]]  # of means, scales, quats, sh0, shN
    mins: NDArray[np.float64]  # (3,)
    maxs: NDArray[np.float64]  # (3,)
    scales: Floats  # (3, 256) the number that each byte stands for, of each channel
    sh0: Floats  # (3, 256)
    opacity: Floats  # (256,) logit
    rest: Floats | None  # (256,) of SH beyond degree 0
    entries: int | None  # of the palette, None = as many as the image has
    degree: int | None  # None = as the width of that image says


def read_sog(path: StrPath) -> Splats:
    """All Gaussians of a SOG, in its order.

    Args: path of a .sog, of a folder with meta.json, or of this meta.json.
    Raises FormatError: it is missing, damaged, of an unknown version, or holds more than `MOST` Gaussians;
    OSError: it cannot be read.
    """
    return _decoded(*_opened(Path(path)))


def count_of(path: StrPath) -> int:
    """How many Gaussians a SOG says that it has. Args and raises as `read_sog`."""
    return _opened(Path(path))[0].count


def _opened(path: Path) -> tuple[_Meta, Folder | Archive]:
    """What meta.json says, and where the images are."""
    if not path.is_file() and not path.is_dir():
        raise FormatError(f"{path}: there is no SOG; give a .sog file, or a folder with meta.json")
    if path.name == INDEX or ((path / INDEX).is_file() and not (path / META).is_file()):
        raise FormatError(f"{path}: a SOG that streams has many files; give the folder of one of them")
    if path.is_dir():
        files: Folder | Archive = Folder(path)
    else:
        files = Folder(path.parent) if path.suffix.lower() == ".json" else Archive(path)
    name = path.name if path.suffix.lower() == ".json" and path.is_file() else META
    meta = _Reader(path).meta(files.read(name, _META_BYTES))
    if meta.count > _FREE + _DENSE * files.size:
        raise FormatError(
            f"{path}: {meta.count:,} Gaussians cannot be in {files.size:,} bytes; export it again"
        )
    return meta, files


def _decoded(meta: _Meta, files: Folder | Archive) -> Splats:
    """The Gaussians of the images."""

    def pixels(part: str, index: int = 0) -> Bytes:
        name = meta.files[part][index]
        most = min(4 * meta.count + _PADDING, _MOST_PIXELS)
        found = _image(files.read(name, _PIXEL_BYTES * most), f"{meta.where}: {name}", most).reshape(-1, 4)
        if len(found) < meta.count:
            wrong = f"{name} has {len(found):,} pixels for {meta.count:,} Gaussians"
            raise FormatError(f"{meta.where}: {wrong}; export it again")
        return found[: meta.count]

    low, high = pixels("means", 0), pixels("means", 1)
    levels = low[:, :3].astype(np.uint16) | high[:, :3].astype(np.uint16) << 8
    places = meta.mins + (meta.maxs - meta.mins) * (levels / 65_535)
    means = np.copysign(np.expm1(np.abs(places)), places).astype(np.float32)
    scales, colours = pixels("scales"), pixels("sh0")
    return Splats(
        means=means,
        quats=_quats(pixels("quats"), meta.where),
        scales=np.column_stack([meta.scales[axis, scales[:, axis]] for axis in range(3)]),
        opacities=meta.opacity[colours[:, 3]],
        sh0=np.column_stack([meta.sh0[channel, colours[:, channel]] for channel in range(3)]),
        shN=_rest(meta, files, pixels("shN", 1))
        if "shN" in meta.files
        else np.zeros((meta.count, 0, 3), np.float32),
    )


def _quats(pixels: Bytes, where: Path) -> Floats:
    """(N, 4) unit quaternions w x y z."""
    largest = pixels[:, 3].astype(np.int64) - _IDENTITY_TAG
    if (largest < 0).any():
        raise FormatError(
            f"{where}: {int((largest < 0).sum()):,} quaternions have a reserved form; export it again"
        )
    kept = (pixels[:, :3] / np.float32(255) - np.float32(0.5)) * np.float32(2**0.5)
    return np.asarray(quaternions(kept, largest), np.float32)


def _rest(meta: _Meta, files: Folder | Archive, labels: Bytes) -> Floats:
    """(N, K, 3) the entries of the palette that labels (N, 4) name."""
    name = meta.files["shN"][0]
    most = COLUMNS * REST[-1] * (MOST_ENTRIES // COLUMNS)
    image = _image(files.read(name, _PIXEL_BYTES * most), f"{meta.where}: {name}", most)
    height, width = image.shape[:2]
    degree = meta.degree or (REST.index(width // COLUMNS) if width // COLUMNS in REST[1:] else 0)
    entries = meta.entries or height * COLUMNS
    if not degree or width != COLUMNS * REST[degree] or height * COLUMNS < entries:
        raise FormatError(f"{meta.where}: {name} is {width} x {height}, which is no palette; export it again")
    chosen = labels[:, 0].astype(np.int64) | labels[:, 1].astype(np.int64) << 8
    if chosen.max(initial=0) >= entries:
        raise FormatError(f"{meta.where}: label {chosen.max()} of a palette of {entries}; export it again")
    assert meta.rest is not None
    palette = meta.rest[image[..., :3].reshape(-1, REST[degree], 3)]
    return np.asarray(palette[chosen], np.float32)


def _image(data: bytes, where: str, most: int) -> Bytes:
    """(H, W, 4) pixels of a WebP or PNG of at most `most` pixels."""
    width, height = _size(data)
    if not 0 < width * height <= most:
        raise FormatError(f"{where}: no WebP or PNG of up to {most:,} pixels; export it again")
    try:
        with Image.open(io.BytesIO(data), formats=("WEBP", "PNG")) as image:
            if image.size == (width, height):
                return np.asarray(image.convert("RGBA"))
    except (*DAMAGE, EOFError, Image.DecompressionBombError) as error:
        raise FormatError(f"{where}: damaged ({str(error)[:80]}); copy or export it again") from error
    raise FormatError(f"{where}: its header contradicts itself; export it again")


def _size(data: bytes) -> tuple[int, int]:
    """(width, height) by the header of a PNG or WebP, (0, 0) for others: before a decoder takes memory."""
    if data[:8] == b"\x89PNG\r\n\x1a\n":
        return int.from_bytes(data[16:20], "big"), int.from_bytes(data[20:24], "big")
    found = read_header(io.BytesIO(data))
    return (0, 0) if found is None else (found.width, found.height)


class _Reader:
    """Checks what meta.json says."""

    def __init__(self, where: Path) -> None:
        self._where = where

    def meta(self, data: bytes) -> _Meta:
        """Raises FormatError if something is missing, or has another form than it must have."""
        try:
            found = json.loads(data)
        except (ValueError, RecursionError) as error:
            raise self._wrong(f"is no JSON ({str(error)[:60]})") from error
        version = self._object(found, "meta.json").get("version", 1)
        if version not in (1, 2) or isinstance(version, bool):
            raise self._wrong(f"is of version {str(version)[:20]}, and 1 and 2 are known")
        parts = {"means": 2, "scales": 1, "quats": 1, "sh0": 1} | ({"shN": 2} if found.get("shN") else {})
        objects = {name: self._object(found.get(name), name) for name in parts}
        files = {name: self._files(objects[name], name, count) for name, count in parts.items()}
        mins, maxs = (self._numbers(objects["means"], "means", bound, 3) for bound in ("mins", "maxs"))
        tables = self._tables(objects) if version == 2 else self._linear(objects)
        shape = objects["means"].get("shape") if version == 1 else [found.get("count")]
        count = self._count(shape[0] if isinstance(shape, list) and shape else None, "count", MOST)
        rest = objects.get("shN")
        stored = rest if version == 2 else None
        return _Meta(
            self._where,
            count,
            files,
            mins,
            maxs,
            *tables,
            entries=None if stored is None else self._count(stored.get("count"), "shN.count", MOST_ENTRIES),
            degree=None if stored is None else self._count(stored.get("bands"), "shN.bands", len(REST) - 1),
        )

    def _tables(self, objects: dict[str, Any]) -> tuple[Floats, Floats, Floats, Floats | None]:
        """The tables of version 2: scales, sh0, opacity and rest."""
        books = {
            name: self._codebook(objects[name], name) for name in ("scales", "sh0", "shN") if name in objects
        }
        alpha = (np.arange(256) / 255).clip(_OPAQUE, 1 - _OPAQUE)
        logit = np.log(alpha / (1 - alpha)).astype(np.float32)
        return np.tile(books["scales"], (3, 1)), np.tile(books["sh0"], (3, 1)), logit, books.get("shN")

    def _linear(self, objects: dict[str, Any]) -> tuple[Floats, Floats, Floats, Floats | None]:
        """The tables of version 1, whose values are evenly spaced: scales, sh0, opacity and rest."""

        def table(name: str, size: int) -> Floats:
            low, high = (self._numbers(objects[name], name, bound, size) for bound in ("mins", "maxs"))
            return np.asarray(low[:, None] + (high - low)[:, None] * (np.arange(256) / 255), np.float32)

        colours = table("sh0", 4)
        rest = table("shN", 1)[0] if "shN" in objects else None
        return table("scales", 3), colours[:3], colours[3], rest

    def _codebook(self, part: dict[str, Any], name: str) -> Floats:
        entries = part.get("codebook")
        if isinstance(entries, list) and len(entries) == 256 and entries[0] is None:
            # Early files have no first entry: readers continue the line of the others.
            rest = self._numbers({"codebook": entries[1:]}, name, "codebook", 255, _LARGEST_ENTRY)
            entries = [float(rest[0] + (rest[0] - rest[-1]) / 255), *rest.tolist()]
        return self._numbers({"codebook": entries}, name, "codebook", 256, _LARGEST_ENTRY).astype(np.float32)

    def _numbers(
        self, part: dict[str, Any], name: str, key: str, size: int, most: float = _LARGEST
    ) -> NDArray[np.float64]:
        values = part.get(key)
        found: list[Any] = values if isinstance(values, list) else [values]
        if len(found) != size or not all(type(each) in (int, float) and abs(each) <= most for each in found):
            raise self._wrong(f"has no {size} numbers of up to ±{most:g} as {name}.{key}")
        return np.array(found, np.float64)

    def _files(self, part: dict[str, Any], name: str, count: int) -> list[str]:
        names = part.get("files")
        if (
            not isinstance(names, list)
            or len(names) < count
            or not all(isinstance(each, str) for each in names)
        ):
            raise self._wrong(f"names no {count} images as {name}.files")
        return names[:count]

    def _count(self, value: object, name: str, most: int) -> int:
        if type(value) not in (int, float) or not 1 <= value <= most or not math.isclose(value % 1, 0):  # type: ignore[operator]
            raise self._wrong(f"has no whole number from 1 to {most:,} as {name}")
        return int(value)  # type: ignore[call-overload, no-any-return]

    def _object(self, value: object, name: str) -> dict[str, Any]:
        if not isinstance(value, dict):
            raise self._wrong(f"has no {name}")
        return value

    def _wrong(self, what: str) -> FormatError:
        return FormatError(f"{self._where}: meta.json {what}; export the model again")
