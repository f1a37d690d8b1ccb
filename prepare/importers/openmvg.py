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

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from panolog.prepare.importers.interface import ImportedScene, ImportSource, find_panorama
from panolog.prepare.importers.json_xml import JsonNode, load_json
from panolog.prepare.importers.point_cloud import PointCloud, read_point_cloud
from panolog.prepare.importers.poses import Array, nearest_rotation
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
_UNDEFINED = 2**32 - 1  # openMVG's id of what is not there
_MIRROR = np.diag([1.0, -1.0, 1.0])


def detect(source: ImportSource) -> bool:
    """Whether this is an sfm_data.json or a folder with one."""
    return b'"sfm_data_version"' in source.json_head(*FILES)


def read(source: ImportSource) -> ImportedScene:
    """Reads the scene; see `interface`."""
    content = load_json(source.json_file(*FILES))
    folders = source.image_folders("images")
    root = content.get("root_path")
    if source.images is None and root is not None and root.value:
        folders = [Path(root.text()), *folders]
    return assemble(content["views"], content["extrinsics"], content, folders, source.cloud_file(*_CLOUDS))


def assemble(
    views: JsonNode, extrinsics: JsonNode, content: JsonNode, folders: Sequence[Path], cloud: Path | None
) -> ImportedScene:
    """The scene of the three parts of an sfm_data: `content` has `intrinsics` and `structure`, if any.

    Raises:
        SceneError: what is wrong with it, with file and field.
    """
    poses = {key: _pose(value) for key, value in _by_key(extrinsics)}
    _check_spherical(views, content)
    points, tracks = _structure(content)
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
        shown, file = find_panorama(name.where, folders, name.text())
        images.append(PosedImage(shown, file, pose[0], -pose[0] @ pose[1], (rows, fractions)))
        widths.append(width)
    mirror = np.eye(3)
    if _is_mirrored(images, points):
        images, points, mirror = [_mirrored(image) for image in images], points @ _MIRROR, _MIRROR
        notes.append("an old openMVG wrote this: its world was a mirror image and is mirrored back")
    images = [_without_half_pixel(image, width) for image, width in zip(images, widths, strict=True)]
    centers = np.array([center for _, center in poses.values()]).reshape(-1, 3)
    points, colors = _colored(points, cloud, centers, mirror)
    return ImportedScene(images, points, colors, notes=notes)


def _by_key(node: JsonNode) -> list[tuple[int, JsonNode]]:
    """(key, value) of the pairs that cereal writes for a map."""
    return [(pair["key"].integer(2**32), pair["value"]) for pair in node]


def _pose(value: JsonNode) -> tuple[Array, Array]:
    """World-to-camera rotation (3, 3) and centre (3,)."""
    matrix = value["rotation"]
    return nearest_rotation(matrix.where, matrix.array(3, 3)), value["center"].array(3)


def _check_spherical(views: JsonNode, content: JsonNode) -> None:
    """Refuses views whose intrinsic is not spherical; a file without intrinsics is accepted.

    cereal writes the name of a class where it first occurs, with the highest bit of its id set.
    """
    intrinsics = content.get("intrinsics")
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


def _structure(content: JsonNode) -> tuple[Array, dict[int, Sightings]]:
    """Points (P, 3), and by view which of them it sees and where, in openMVG's pixels."""
    structure = content.get("structure")
    points: list[Array] = []
    seen: dict[int, tuple[list[int], list[Array]]] = {}
    for row, (_, value) in enumerate(_by_key(structure) if structure is not None else []):
        points.append(value["X"].array(3))
        for view, observation in _by_key(value["observations"]):
            rows, pixels = seen.setdefault(view, ([], []))
            rows.append(row)
            pixels.append(observation["x"].array(2))
    tracks = {view: (np.array(rows, np.int64), np.array(pixels)) for view, (rows, pixels) in seen.items()}
    return np.array(points).reshape(-1, 3), tracks


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
    """The same with the half pixel in longitude taken out; the centre stays.

    What openMVG saw at longitude 2π(u - W/2)/W is at 2π(u + 0.5 - W/2)/W: the camera turns by π/W
    about its y.
    """
    angle = np.pi / width
    turn = np.array(
        [[np.cos(angle), 0.0, np.sin(angle)], [0.0, 1.0, 0.0], [-np.sin(angle), 0.0, np.cos(angle)]]
    )
    rotation = turn @ image.rotation
    return replace(image, rotation=rotation, translation=rotation @ image.rotation.T @ image.translation)


def _colored(points: Array, path: Path | None, centers: Array, mirror: Array) -> PointCloud:
    """The points with the colours of the PLY; without points, those of the PLY that are no cameras."""
    if path is None:
        return points, None
    cloud, colors = read_point_cloud(path)
    if not len(points):
        return _without_cameras(cloud @ mirror, colors, centers @ mirror)
    if colors is None or not len(cloud):
        return points, None
    distance, nearest = cKDTree(cloud @ mirror).query(points)
    if np.median(distance) > 1e-3 * np.ptp(points, axis=0).max():
        raise SceneError(f"{path}: its vertices are not the points of the structure; omit it")
    return points, colors[nearest]


def _without_cameras(points: Array, colors: NDArray[np.uint8] | None, centers: Array) -> PointCloud:
    """Drops the green vertices at the cameras' places."""
    if colors is None or not len(points) or not len(centers):
        return points, colors
    near = cKDTree(centers).query(points)[0] < 1e-4 * max(float(np.ptp(centers, axis=0).max()), 1e-9)
    kept = ~(near & (colors == (0, 255, 0)).all(axis=1))
    return points[kept], colors[kept]
