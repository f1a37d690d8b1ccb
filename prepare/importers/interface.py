"""What every importer takes and returns, how it finds the files of its format, and converts poses.

An importer has two functions. `detect(source)` reads file names and first bytes only. `read(source)` converts
the whole scene to our convention; it raises SceneError, with file and field, if anything in the files is
wrong, and OSError if a file cannot be read.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path, PurePosixPath

import numpy as np
from numpy.typing import NDArray

from panolog.prepare.importers.json_xml import MEMORY, JsonNode
from panolog.prepare.importers.point_cloud import PointCloud, read_point_cloud
from panolog.prepare.panorama_files import SUFFIXES
from panolog.scene.errors import SceneError
from panolog.scene.files import file_of, stem_of
from panolog.scene.write import UNSEEN, Origin, PosedImage

Array = NDArray[np.float64]
FLIP_YZ = np.diag([1.0, -1.0, -1.0])  # OpenGL's camera (x right, y up, z backward) to ours, and back
_TOLERANCE = 1e-3  # how far from orthonormal a rotation that was written as text may be
ENDINGS = (*SUFFIXES, *(end.upper() for end in SUFFIXES))
_HEAD = 65_536  # bytes that `detect` may read of a file
_LARGEST_LIST = 2**26  # bytes of a file of image names


@dataclass(frozen=True, eq=False)
class ImportedScene:
    """The content of a scene of another program."""

    images: Sequence[PosedImage]
    points: NDArray[np.float64]  # (P, 3) world units
    colors: NDArray[np.uint8] | None  # (P, 3) RGB; None where the format has none: sampled from the panoramas
    train: Sequence[str] = ()  # stems, where the format has a split of its own
    test: Sequence[str] = ()
    notes: Sequence[str] = ()  # messages for the user, one line each: what was left out
    place: Origin | None = None  # the world is metres east, north and up of it
    masks: Mapping[str, Path] = field(default_factory=dict)  # by image name, where the format names them

    def with_cloud(self, source: "ImportSource") -> "ImportedScene":
        """The scene with the points of the user's PLY, which no panorama is known to see, if there is one."""
        if source.points is None:
            return self
        points, colors = read_point_cloud(source.points, source.memory)
        images = [replace(image, sightings=UNSEEN) for image in self.images]
        return replace(self, images=images, points=points, colors=colors)


@dataclass(frozen=True)
class ImportSource:
    """What the user gave."""

    path: Path  # a file or a folder
    images: Path | None = None  # where the panoramas are, if not where the format says
    points: Path | None = None  # a PLY, if the format has no points or another cloud is wanted
    memory: int = MEMORY  # bytes that reading it may take

    @property
    def folder(self) -> Path:
        """The folder that `path` is, or is in."""
        return self.path if self.path.is_dir() else self.path.parent

    def first(self, *names: str) -> Path | None:
        """`path` itself if it is a file of one of these names, else the first that is in the folder."""
        if self.path.is_file():
            return self.path if self.path.name in {Path(name).name for name in names} else None
        return next((self.path / name for name in names if (self.path / name).is_file()), None)

    def json_file(self, *names: str) -> Path:
        """The file of one of these names, or else `path`, which the user may have renamed."""
        return self.first(*names) or self.path

    def json_head(self, *names: str) -> bytes:
        """The first bytes of `json_file` without leading blanks; none if it is no .json file."""
        path = self.json_file(*names)
        return read_head(path).lstrip() if path.is_file() and path.suffix == ".json" else b""

    def image_folders(self, *names: str) -> list[Path]:
        """Where to look for panoramas: the user's folder, else those of `names` in the folder, and itself."""
        if self.images is not None:
            return [self.images]
        return [*(self.folder / name for name in names if (self.folder / name).is_dir()), self.folder]

    def cloud_file(self, *names: str) -> Path | None:
        """The user's PLY, else the first of `names` in the folder; None if there is none."""
        found = (self.folder / name for name in names)
        return self.points or next(filter(Path.is_file, found), None)

    def cloud(self, *names: str) -> PointCloud:
        """The points of `cloud_file`; none without a file. Raises SceneError as `read_point_cloud`."""
        return read_point_cloud(self.cloud_file(*names), self.memory)

    def split(self) -> tuple[list[str], list[str]]:
        """Stems in train.txt and test.txt of the folder. Raises SceneError as `read_stems`."""
        return read_stems(self.folder / "train.txt"), read_stems(self.folder / "test.txt")


def read_head(path: Path) -> bytes:
    """The first bytes of a file, enough to recognize its format."""
    with path.open("rb") as file:
        return file.read(_HEAD)


def nearest_rotation(where: str, matrix: Array) -> Array:
    """(3, 3) the rotation nearest to `matrix` (3, 3).

    Raises SceneError: it is none, even roughly, or it mirrors; `where` says which field it is.
    """
    if np.abs(matrix @ matrix.T - np.eye(3)).max() > _TOLERANCE:
        raise SceneError(f"{where}: is not a rotation (its rows are not orthonormal); export it again")
    left, _, right = np.linalg.svd(matrix)
    nearest: Array = left @ right
    if np.linalg.det(nearest) < 0:
        raise SceneError(f"{where}: mirrors (its determinant is -1), so it is not a camera pose")
    return nearest


def pose_from_camera_to_world(where: str, matrix: Array, axes: Array) -> tuple[Array, Array]:
    """(rotation, translation), world-to-camera, of a camera-to-world matrix (3 or 4, 4).

    `axes` (3, 3) maps our camera axes to those of the format: `FLIP_YZ` or the identity. A uniform scale in
    the matrix is taken out, as it has no meaning for a camera.

    Raises SceneError: its left part is not a rotation.
    """
    scale = np.cbrt(abs(np.linalg.det(matrix[:3, :3])))
    if not 1e-9 < scale < 1e9:
        raise SceneError(f"{where}: is not a pose (its determinant is {scale**3:.3g}); export it again")
    turned = nearest_rotation(where, matrix[:3, :3] / scale) @ axes
    return turned.T, -turned.T @ matrix[:3, 3]


def posed_image(
    matrix: JsonNode, name: JsonNode, folders: Sequence[Path], axes: Array, *, spelled: str | None = None
) -> PosedImage:
    """A panorama with a camera-to-world matrix (3 or 4, 4).

    Args:
        axes: (3, 3) as in `pose_from_camera_to_world`.
        spelled: the name to look for, if not as it is in the file.

    Raises SceneError: the matrix is no pose, or there is no such file.
    """
    rows = 3 if len(matrix) == 3 else 4
    rotation, translation = pose_from_camera_to_world(matrix.where, matrix.array(rows, 4), axes)
    return PosedImage(*find_panorama(name.where, folders, spelled or name.text()), rotation, translation)


def find_panorama(where: str, folders: Sequence[Path], name: str) -> tuple[str, Path]:
    """(name in the scene, file) of the panorama that a format calls `name`.

    Searches `folders` in order for the name, for its last part, and for both with another extension: programs
    write names without one, or with that of the original. Folders in the name are kept.

    Raises SceneError: the name leaves the folder, or no file belongs to it; `where` says which field named
    it.
    """
    clean = PurePosixPath(name.replace("\\", "/"))
    if clean.is_absolute():
        clean = PurePosixPath(clean.name)
    if ".." in clean.parts or not clean.name or "\0" in name or len(name) > 1024:
        raise SceneError(f"{where}: the image name {name[:80]!r} is not a path inside the image folder")
    try:
        for folder in folders:
            for candidate in _spellings(clean):
                if (found := file_of(folder, str(candidate))).is_file():
                    return str(candidate), found
    except (ValueError, OSError) as error:  # a name that no file system can have
        raise SceneError(f"{where}: the image name {name[:80]!r} cannot be a file's") from error
    searched = " or ".join(dict.fromkeys(map(str, folders)))
    raise SceneError(f"{where}: {name[:80]} is not in {searched}; say where the panoramas are with --images")


def _spellings(name: PurePosixPath) -> Iterator[PurePosixPath]:
    """The paths that a program may mean by a name, the likeliest first."""
    for path in dict.fromkeys((name, PurePosixPath(name.name))):
        yield path
        yield from (path.with_name(path.name + suffix) for suffix in ENDINGS)
        yield from (path.with_name(stem_of(path.name) + suffix) for suffix in ENDINGS)


def read_stems(path: Path) -> list[str]:
    """The lines of a split file without the extensions of images; empty without the file.

    Raises SceneError: the file is not text, or too large to be a list of names.
    """
    if not path.is_file():
        return []
    if path.stat().st_size > _LARGEST_LIST:
        raise SceneError(f"{path}: too large to be a list of images")
    try:
        lines = path.read_text(encoding="utf-8-sig").split("\n")
    except UnicodeDecodeError as error:
        raise SceneError(f"{path}: is not UTF-8; save it as UTF-8") from error
    names = [PurePosixPath(line.strip().replace("\\", "/")) for line in lines if line.strip()]
    return [str(name.with_suffix("")) if name.suffix in ENDINGS else str(name) for name in names]
