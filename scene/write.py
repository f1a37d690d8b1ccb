"""Writes posed panoramas and a cloud as a scene of ours, which appears whole or not at all."""

import secrets
import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from panolog.scene.colmap import write_colmap
from panolog.scene.errors import InputError, SceneError, wrong_value
from panolog.scene.files import SUFFIX, stem_of, write_bytes
from panolog.scene.image_files import decode_with_alpha
from panolog.scene.read import read_scene

Sightings = tuple[NDArray[np.int64], NDArray[np.float64]]  # (M,) rows of the points, (M, 2) u/W and v/H
Progress = Callable[[int, int], None]  # steps done, steps in all
StageProgress = Callable[[str, int, int], None]  # name of the stage, steps done, steps in all
UNSEEN: Sightings = (np.empty(0, np.int64), np.empty((0, 2)))
OFFSET_FILE = "offset.json"
_GREY = 128  # of points that no panorama shows
_Coordinate = Annotated[float, Field(gt=-1e12, lt=1e12)]


def no_progress(*_: object) -> None:
    """The `Progress` that reports nothing."""


def part_of(progress: Progress, turn: int, count: int) -> Progress:
    """The `Progress` of one of several works of about equal length. Args: turn, from 0 on; count, of all."""
    return lambda done, total: progress(turn * total + done, count * total)


class _Strict(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, allow_inf_nan=False)


class Origin(_Strict):
    """A place on WGS84."""

    latitude: float = Field(ge=-90, le=90, description="degrees north")
    longitude: float = Field(ge=-180, le=180, description="degrees east")
    altitude: float = Field(
        gt=-1e6, lt=1e6, description="metres, as GPS gave it: receivers differ in what it is above"
    )


class Offset(_Strict):
    """SCENE/offset.json: where the scene's coordinates are in the world that they came from.

        {"offset": [x, y, z]}
        {"offset": [x, y, z], "frame": "ENU", "origin": {"latitude": φ, "longitude": λ, "altitude": h}}
        {"offset": [x, y, z], "metres": 1, "epsg": 32632}

    A scene's coordinates plus `offset` are the source's: those of the program that it was imported from, or
    metres east, north and up of `origin` (WGS84; degrees, metres). One may add what is known of others:
    `epsg`, the number of the source's coordinate system (projected, or geocentric), the metres of a unit, or
    `geoid`, if heights are above the sea: how high it is there above the ellipsoid. Training computes in
    float32, so large numbers are here and never in the coordinates.
    """

    offset: tuple[_Coordinate, _Coordinate, _Coordinate] = Field(description="to be added, in scene units")
    frame: Literal["ENU"] | None = Field(
        default=None, description="ENU = metres east, north, up of the origin"
    )
    origin: Origin | None = None
    epsg: int | None = Field(default=None, ge=1, le=999_999, description="of the source's coordinate system")
    metres: float | None = Field(default=None, gt=0, lt=1e9, description="of a unit of the scene")
    geoid: float | None = Field(
        default=None,
        ge=-120,
        le=120,
        description="metres of the geoid above the ellipsoid, of heights above it",
    )

    @model_validator(mode="after")
    def _together(self) -> "Offset":
        if (self.frame is None) != (self.origin is None):
            raise ValueError("frame and origin belong together; give both or neither")
        if self.frame and self.epsg:
            raise ValueError(
                "the source's coordinates are those of the frame or of the epsg; give one of them"
            )
        return self


@dataclass(frozen=True, eq=False)
class PosedImage:
    """One panorama. Camera axes x right, y down, z forward; X_cam = rotation @ X + translation."""

    name: str  # relative to the image folder of the scene
    file: Path
    rotation: NDArray[np.float64]  # (3, 3)
    translation: NDArray[np.float64]  # (3,)
    sightings: Sightings = UNSEEN  # which points it sees, and where as fractions of width and height
    quaternion: NDArray[np.float64] | None = None  # (4,) w x y z, kept bit by bit; None: of the rotation
    layers: Mapping[str, Path] = field(default_factory=dict)  # the files of those that it has, by folder


@dataclass(frozen=True, eq=False)
class NewScene:
    """What a scene is written from."""

    images: Sequence[PosedImage]  # in the natural order of their names
    size: tuple[int, int]  # width and height of each
    points: NDArray[np.float64]  # (P, 3) world units
    colors: NDArray[np.uint8] | None  # (C, 3) RGB of the first C points; others' are from the panoramas
    split: Mapping[str, Sequence[str]] | None = None  # stems by "train.txt" and "test.txt"; None: every 8th
    offset: Offset | None = None


def require_new(output: Path) -> None:
    """Raises SceneError if there is something at `output` already."""
    if output.exists() and (not output.is_dir() or any(output.iterdir())):
        raise SceneError(f"{output}: already exists; give a new folder")


def write_scene(
    output: Path,
    new: NewScene,
    *,
    link: bool,
    progress: Progress = no_progress,
    complete: Callable[[Path], None] = no_progress,
) -> None:
    """Writes `new` to the folder `output`, which must be new or empty.

    Args:
        progress: called after each panorama that is copied, and again after each that gives points a colour.
        complete: called with the folder before it is at `output`, for what else belongs into it.

    Raises SceneError: it could not be trained; `output` is then untouched; OSError: a file cannot be read or
    written.
    """
    target = output.resolve()
    target.parent.mkdir(parents=True, exist_ok=True)
    temporary = target.with_name(f".{target.name}.{secrets.token_hex(4)}{SUFFIX}")
    try:
        colors = np.empty((0, 3), np.uint8) if new.colors is None else new.colors
        given = len(colors)
        steps = len(new.images) * (2 if given < len(new.points) else 1)
        _copy_files(temporary, new, link, lambda done, _: progress(done, steps))
        if given < len(new.points):
            seen = _sampled(new.images, len(new.points), lambda done, total: progress(total + done, steps))
            colors = np.concatenate([colors, seen[given:]])
        write_colmap(
            temporary / "sparse" / "0",
            [
                (it.name, it.rotation if it.quaternion is None else it.quaternion, it.translation)
                for it in new.images
            ],
            width=new.size[0],
            height=new.size[1],
            points=new.points,
            colors=colors,
            observations=[(rows, fractions * new.size) for rows, fractions in map(_once, new.images)],
        )
        for name, members in (new.split or {}).items():
            write_bytes(temporary / name, ("\n".join(members) + "\n").encode())
        if new.offset is not None:
            write_offset(temporary, new.offset)
        complete(temporary)
        _check(temporary, output)
        temporary.replace(target)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def read_offset(scene: Path) -> Offset | None:
    """SCENE/offset.json; None if there is none. Raises SceneError if it is not of this format."""
    path = scene / OFFSET_FILE
    try:
        return Offset.model_validate_json(path.read_bytes())
    except FileNotFoundError:
        return None
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(map(str, first["loc"]))
        raise SceneError(f"{path}: {where + ': ' if where else ''}{wrong_value(first)}") from error
    except OSError as error:
        raise SceneError(f"{path}: cannot be read: {error.strerror}") from error


def write_offset(scene: Path, offset: Offset) -> None:
    """Writes SCENE/offset.json, atomically. Raises OSError if it cannot be written."""
    write_bytes(scene / OFFSET_FILE, offset.model_dump_json(exclude_none=True).encode() + b"\n")


def _copy_files(folder: Path, new: NewScene, link: bool, progress: Progress) -> None:
    """The panoramas and their layers."""
    for done, image in enumerate(new.images, start=1):
        _copy(image.file, folder / "images" / image.name, link)
        for layer, file in image.layers.items():
            _copy(file, folder / layer / f"{stem_of(image.name)}.png", link)
        progress(done, len(new.images))


def _copy(file: Path, target: Path, link: bool) -> None:
    target.parent.mkdir(parents=True, exist_ok=True)
    if link:
        target.symlink_to(file.resolve())
    else:
        shutil.copyfile(file, target)


def _once(image: PosedImage) -> Sightings:
    """The sightings of an image, each point at most once."""
    rows, fractions = image.sightings
    _, first = np.unique(rows, return_index=True)
    return rows[first], fractions[first]


def _sampled(images: Sequence[PosedImage], points: int, progress: Progress) -> NDArray[np.uint8]:
    """(points, 3) the mean RGB of the pixels where each point is seen."""
    total, count = np.zeros((points, 3)), np.zeros(points)
    for done, image in enumerate(images, start=1):
        rows, fractions = image.sightings
        if len(rows):
            pixels, used = decode_with_alpha(image.file)
            limit = np.array([pixels.shape[1], pixels.shape[0]])
            u, v = np.clip(np.floor(fractions * limit), 0, limit - 1).astype(np.int64).T
            if used is not None:
                rows, v, u = rows[used[v, u]], v[used[v, u]], u[used[v, u]]
            np.add.at(total, rows, pixels[v, u])
            np.add.at(count, rows, 1)
        progress(done, len(images))
    mean = np.where(count[:, None] > 0, total / np.maximum(count, 1)[:, None], _GREY)
    return np.rint(mean).astype(np.uint8)


def _check(temporary: Path, output: Path) -> None:
    """Reads the scene as training will; errors name the folder that the user knows."""
    try:
        read_scene(temporary)
    except InputError as error:
        raise SceneError(str(error).replace(str(temporary), str(output))) from error
