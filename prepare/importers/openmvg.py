"""openMVG's sfm_data.json with a spherical intrinsic, and the layouts of OmniGS that hold one.

Camera x right, y down, z forward (right-handed); longitude 0, the middle column, is +z, and u = W (lon / 2π)
+ W/2. `rotation` is world-to-camera and `center` the camera's place: X_cam = R (X - C). World units and axes
are arbitrary. Source: openMVG's cameras/Camera_Spherical.hpp and sfm/sfm_data_io_cereal.hpp.

- Pixels have their centre at whole numbers, as its samplers and SIFT have them, while W/2 is taken as the
  middle. The half pixel in longitude is taken out of the pose here (`_without_half_pixel`); the one in
  latitude is not a rotation, so half a pixel of residual stays in what openMVG had reconstructed.
- Older versions had y up in the camera, so that their world is a mirror image. Where the file has tracks,
  their residuals show which of the two it is, and the world is mirrored back.
- Colours are in colorized.ply (openMVG_main_ComputeSfM_DataColor), whose last, green vertices are the
  cameras.
- OmniGS keeps poses and cloud apart: openMVG/reconstruction/poses.json and colorized.ply.
"""

from array import array
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path, PurePosixPath

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from panolog.prepare.importers.interface import (
    Array,
    ImportedScene,
    ImportSource,
    find_panorama,
    nearest_rotation,
)
from panolog.prepare.importers.json_xml import JsonNode, load_json_in_pieces
from panolog.prepare.importers.point_cloud import PointCloud
from panolog.scene.colmap import LARGEST
from panolog.scene.errors import SceneError
from panolog.scene.projection import project_to_fractions
from panolog.scene.write import UNSEEN, PosedImage, Sightings

FILES = (
    "sfm_data.json",
    "openMVG/reconstruction/poses.json",
    "openMVG/data_openmvg.json",
    "data_openmvg.json",
)
_CLOUDS = ("colorized.ply", "reconstruction/colorized.ply", "openMVG/reconstruction/colorized.ply")
_OBSERVATION = 250  # bytes that one needs here and, as an object of COLMAP, while the scene is written
_UNDEFINED = 2**32 - 1  # openMVG's id of what is not there
_MIRROR = np.diag([1.0, -1.0, 1.0])


def detect(source: ImportSource) -> bool:
    """Whether this is an sfm_data.json or a folder with one."""
    return b'"sfm_data_version"' in source.json_head(*FILES)


def read(source: ImportSource) -> ImportedScene:
    """Reads the scene; see `interface`."""
    path = source.json_file(*FILES)
    structure = _Structure(path, source.memory)
    content = load_json_in_pieces(path, "structure", structure.add, source.memory)
    folders = source.image_folders("images")
    root = content.get("root_path")
    if source.images is None and root is not None and root.value:
        folders = [Path(root.text()), *folders]
    cloud, views = source.cloud(*_CLOUDS), content["views"]
    return assemble(views, content["extrinsics"], folders, cloud, content.get("intrinsics"), structure)


def assemble(
    views: JsonNode,
    extrinsics: JsonNode,
    folders: Sequence[Path],
    cloud: PointCloud,
    intrinsics: JsonNode | None = None,
    structure: "_Structure | None" = None,
) -> ImportedScene:
    """The scene of the parts of an sfm_data. Raises SceneError with file and field."""
    structure = structure or _Structure(views.path, 0)
    poses = {key: _pose(value) for key, value in _by_key(extrinsics)}
    _check_spherical(views, intrinsics)
    points, tracks = structure.points, structure.tracks
    images: list[PosedImage] = []
    widths: list[int] = []
    notes: list[str] = []
    for key, view in _by_key(views):
        data = view["ptr_wrapper"]["data"]
        pose = poses.get(data["id_pose"].integer(2**32))
        name = data["filename"]
        if pose is None:
            notes.append(f"{name.text()[:80]} has no pose and is left out")
            continue
        width, height = data["width"].integer(2**20), data["height"].integer(2**20)
        if width != 2 * height or height < 1:
            raise data.error(f"{width} x {height} pixels are not 2:1, so it is not a panorama")
        rows, pixels = tracks.get(key, UNSEEN)
        fractions = (pixels + 0.5) / (width, height)
        shown, file = find_panorama(name.where, folders, _path(data))
        images.append(PosedImage(shown, file, pose[0], -pose[0] @ pose[1], (rows, fractions)))
        widths.append(width)
    mirror = np.eye(3)
    if _is_mirrored(images, points):
        images, points, mirror = [_mirrored(image) for image in images], points @ _MIRROR, _MIRROR
        notes.append("an old openMVG wrote this: its world was a mirror image and is mirrored back")
    images = [_without_half_pixel(image, width) for image, width in zip(images, widths, strict=True)]
    centers = np.array([center for _, center in poses.values()]).reshape(-1, 3)
    points, colors = _colored(views.path, points, cloud, centers, mirror)
    return ImportedScene(images, points, colors, notes=notes)


def _by_key(node: JsonNode) -> list[tuple[int, JsonNode]]:
    """(key, value) of the pairs that cereal writes for a map."""
    return [(pair["key"].integer(2**32), pair["value"]) for pair in node]


def _path(data: JsonNode) -> str:
    """The file of a view below the root: openMVG writes its folder and its name apart."""
    given, name = data.get("local_path"), data["filename"].text()
    folder = PurePosixPath("" if given is None else given.text())
    return name if folder.is_absolute() or ".." in folder.parts else str(folder / name)


def _pose(value: JsonNode) -> tuple[Array, Array]:
    """World-to-camera rotation (3, 3) and centre (3,)."""
    matrix = value["rotation"]
    return nearest_rotation(matrix.where, matrix.array(3, 3)), value["center"].array(3)


def _check_spherical(views: JsonNode, intrinsics: JsonNode | None) -> None:
    """Refuses views whose intrinsic is not spherical; a file without intrinsics is accepted.

    cereal writes the name of a class where it first occurs, with the highest bit of its id set.
    """
    if intrinsics is None or not len(intrinsics):
        return
    names: dict[int, str] = {}
    kinds: dict[int, str] = {}
    for key, value in _by_key(intrinsics):
        number = value["polymorphic_id"].integer(2**32) & 0x7FFFFFFF
        name = value.get("polymorphic_name")
        names[number] = name.text() if name is not None else names.get(number, "unknown")
        kinds[key] = names[number]
    for _, view in _by_key(views):
        data = view["ptr_wrapper"]["data"]
        key = data["id_intrinsic"].integer(2**32)
        if data["id_pose"].integer(2**32) != _UNDEFINED and kinds.get(key, "missing") != "spherical":
            raise data.error(
                f"its intrinsic is {kinds.get(key, 'missing')[:40]}, and only spherical ones are panoramas"
            )


class _Structure:
    """The points of an sfm_data, and by view which of them it sees and where: members of `structure`."""

    def __init__(self, path: Path, memory: int) -> None:
        """Args: path, for messages; memory, bytes that all of it may need until the scene is written."""
        self._path, self._left = path, memory
        self._points = array("d")
        self._seen: dict[int, tuple[array[int], array[float]]] = {}

    def add(self, member: JsonNode) -> None:
        """Adds a point with its observations. Raises SceneError if it is none, or there are too many."""
        value = member["value"]
        observations = value["observations"]
        row = len(self._points) // 3
        self._points.extend(value["X"].array(3))
        self._left -= _OBSERVATION * (1 + len(observations))
        if self._left < 0:
            raise SceneError(
                f"{self._path}: it has more observations than the memory that is free holds; free some, or "
                "export it without structure, and the points as a PLY"
            )
        if not isinstance(observations.value, list):
            raise observations.error("a list [...] was expected")
        for index in range(len(observations)):
            view, x, y = _observed(observations, index)
            if (seen := self._seen.get(view)) is None:
                seen = self._seen[view] = array("q"), array("d")
            seen[0].append(row)
            seen[1].append(x)
            seen[1].append(y)

    @property
    def points(self) -> Array:
        """(P, 3)."""
        return np.array(self._points).reshape(-1, 3)

    @property
    def tracks(self) -> dict[int, Sightings]:
        """By view, which points it sees, and where in openMVG's pixels."""
        return {
            view: (np.array(rows, np.int64), np.array(pixels).reshape(-1, 2))
            for view, (rows, pixels) in self._seen.items()
        }


def _observed(observations: JsonNode, index: int) -> tuple[int, float, float]:
    """The view and the pixel of an observation. Raises SceneError, with the field, if it is none."""
    value = observations.value[index]
    match value:  # there are millions of them
        case {"key": int(view), "value": {"x": [int(x) | float(x), int(y) | float(y)]}}:
            if 0 <= view < 2**32 and abs(x) < LARGEST and abs(y) < LARGEST:
                return view, x, y
    node = JsonNode(observations.path, value, f"{observations.field}[{index}]")
    x, y = node["value"]["x"].array(2)
    return node["key"].integer(2**32), float(x), float(y)


def _is_mirrored(images: Sequence[PosedImage], points: Array) -> bool:
    """Whether the tracks fit much better with y up in the cameras than with y down."""
    down, up = [], []
    for image in images:
        rows, seen = image.sightings
        if len(rows) and rows.max() < len(points):
            v = project_to_fractions(points[rows] @ image.rotation.T + image.translation)[:, 1]
            down.append(np.abs(v - seen[:, 1]))
            up.append(np.abs(1 - v - seen[:, 1]))
    if not down:
        return False
    return bool(np.median(np.concatenate(up)) < 0.25 * np.median(np.concatenate(down)))


def _mirrored(image: PosedImage) -> PosedImage:
    """The pose of a camera with y up (left-handed) in a mirrored world, as one of ours in the true world."""
    rotation = _MIRROR @ image.rotation @ _MIRROR
    return replace(image, rotation=rotation, translation=_MIRROR @ image.translation)


def _without_half_pixel(image: PosedImage, width: int) -> PosedImage:
    """The image with the half pixel in longitude taken out; the centre stays.

    What openMVG saw at longitude 2π(u - W/2)/W is at 2π(u + 0.5 - W/2)/W: the camera turns by π/W
    about its y.
    """
    angle = np.pi / width
    turn = np.array(
        [[np.cos(angle), 0.0, np.sin(angle)], [0.0, 1.0, 0.0], [-np.sin(angle), 0.0, np.cos(angle)]]
    )
    rotation = turn @ image.rotation
    return replace(image, rotation=rotation, translation=rotation @ image.rotation.T @ image.translation)


def _colored(path: Path, points: Array, cloud: PointCloud, centers: Array, mirror: Array) -> PointCloud:
    """The points with the colours of a cloud; without points, those of the cloud that are no cameras."""
    vertices, colors = cloud
    if not len(points):
        return _without_cameras(vertices @ mirror, colors, centers @ mirror)
    if colors is None or not len(vertices):
        return points, None
    distance, nearest = cKDTree(vertices @ mirror).query(points)
    if np.median(distance) > 1e-3 * np.ptp(points, axis=0).max():
        raise SceneError(f"{path}: the vertices of its PLY are not the points of its structure; omit the PLY")
    return points, colors[nearest]


def _without_cameras(points: Array, colors: NDArray[np.uint8] | None, centers: Array) -> PointCloud:
    """Drops the green vertices at the cameras' places."""
    if colors is None or not len(points) or not len(centers):
        return points, colors
    near = cKDTree(centers).query(points)[0] < 1e-4 * max(float(np.ptp(centers, axis=0).max()), 1e-9)
    kept = ~(near & (colors == (0, 255, 0)).all(axis=1))
    return points[kept], colors[kept]
