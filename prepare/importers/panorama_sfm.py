"""COLMAP models of perspective faces, as pycolmap's panorama_sfm writes them, back to panoramas.

The faces are images `pano_cameraK/NAME` with (simple) pinhole cameras; K numbers the directions. A face's
rotation from the panorama is Rx(-pitch) Ry(-yaw), and face 0 has yaw 0: it faces the middle column, up or
down by its pitch. The panorama's camera is x right, y down, z forward with longitude 0 at +z; poses are
world-to-camera; pixel centres are at +0.5. World units and axes are arbitrary. Source: COLMAP's
python/examples/panorama_sfm.py.

Yaws and pitches are not in the files. But face 1 has the pitch of face 0, so the rotation between them turns
about the panorama's vertical axis, which gives the pitch; all other faces follow from their rotation against
face 0. That the faces of a panorama then agree is checked. The panoramas themselves must be given with
--images.
"""

import re
from collections import defaultdict
from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from panolog.prepare.importers.interface import Array, ImportedScene, ImportSource, find_panorama
from panolog.prepare.importers.spheresfm import camera_models, find_model, require_model
from panolog.scene.colmap import ColmapImage, read_colmap
from panolog.scene.colmap_files import PINHOLE, SIMPLE_PINHOLE
from panolog.scene.errors import SceneError
from panolog.scene.projection import project_to_fractions
from panolog.scene.write import PosedImage, Sightings

_FACE = re.compile(r"pano_camera(\d{1,4})/(.+)")
_AGREE = 2e-3  # radians between the poses that two faces give their panorama, and of face 0's roll
PanoramaFaces = dict[int, ColmapImage]


def detect(source: ImportSource) -> bool:
    """Whether this is a folder with a model of pinholes whose images are called pano_camera…"""
    folder = find_model(source.path)
    models = camera_models(folder)
    if folder is None or not models or models - {PINHOLE, SIMPLE_PINHOLE}:
        return False
    path = next(folder / name for name in ("images.bin", "images.txt") if (folder / name).is_file())
    with path.open("rb") as file:
        return b"pano_camera" in file.read(2**20)


def read(source: ImportSource) -> ImportedScene:
    """Reads the scene; see `interface`."""
    folder = require_model(source.path)
    if source.images is None:
        raise SceneError(f"{folder}: contains faces only; say where their panoramas are with --images")
    model = read_colmap(folder)
    panoramas: defaultdict[str, PanoramaFaces] = defaultdict(dict)
    for image in model.images:
        match = _FACE.fullmatch(image.name)
        if match is None or image.camera.model not in (PINHOLE, SIMPLE_PINHOLE):
            raise SceneError(
                f"{folder}: images: {image.name[:60]!r} is not a face of a panorama (pano_cameraK/NAME)"
            )
        panoramas[match[2]][int(match[1])] = image
    cameras = _directions(str(folder), list(panoramas.values()))
    images = []
    for name, faces in panoramas.items():
        found = find_panorama(f"{folder}: images", [source.images], name)
        rotation, translation = _pose(f"{folder}: images: {name[:60]}", faces, cameras)
        images.append(PosedImage(*found, rotation, translation, _sightings(faces, cameras)))
    return ImportedScene(images, model.points, model.colors).with_cloud(source)


def _directions(where: str, panoramas: Sequence[PanoramaFaces]) -> Mapping[int, Array]:
    """The rotation (3, 3) of each face from its panorama, found from how the faces stand to each other."""
    against_first: dict[int, Array] = {}
    for faces in panoramas:
        if 0 in faces:
            for number, face in faces.items():
                against_first.setdefault(number, face.rotation @ faces[0].rotation.T)
    if 1 not in against_first:
        raise SceneError(f"{where}: no panorama has both faces 0 and 1, so their directions are unknown")
    turn = -Rotation.from_matrix(against_first[1]).as_rotvec()
    angle = np.linalg.norm(turn)
    if not 1e-3 < angle < np.pi - 1e-3 or abs(turn[0]) > _AGREE * angle:
        raise SceneError(f"{where}: face 1 is not next to face 0; this is not a layout of panorama_sfm")
    first = Rotation.from_euler("X", -np.arctan2(-turn[2], turn[1])).as_matrix()
    return {number: rotation @ first for number, rotation in against_first.items()}


def _pose(where: str, faces: PanoramaFaces, cameras: Mapping[int, Array]) -> tuple[Array, Array]:
    """The panorama's world-to-camera pose: of its first face, and the others must agree."""
    poses = []
    for number, face in sorted(faces.items()):
        if number not in cameras:
            raise SceneError(f"{where}: the direction of face {number} is unknown; leave that face out")
        poses.append((cameras[number].T @ face.rotation, cameras[number].T @ face.translation))
    rotation, translation = poses[0]
    center = -rotation.T @ translation
    for other, shift in poses[1:]:
        apart = Rotation.from_matrix(other @ rotation.T).magnitude()
        gap = float(np.linalg.norm(-other.T @ shift - center))
        if apart > _AGREE or gap > _AGREE * (1 + float(np.linalg.norm(center))):
            raise SceneError(
                f"{where}: its faces disagree by {apart:.3g} rad and {gap:.3g} units; map them as a rig"
            )
    return rotation, translation


def _sightings(faces: PanoramaFaces, cameras: Mapping[int, Array]) -> Sightings:
    """What the faces see, on the panorama; a point that several of them see counts once."""
    rows: list[NDArray[np.int64]] = []
    where: list[Array] = []
    for number, face in sorted(faces.items()):
        camera = face.camera
        fx, fy = (camera.params[0],) * 2 if camera.model == SIMPLE_PINHOLE else camera.params[:2]
        middle = np.array(camera.params[-2:])
        rays = np.column_stack([(face.pixels - middle) / (fx, fy), np.ones(len(face.pixels))])
        rows.append(face.points)
        where.append(project_to_fractions(rays @ cameras[number]))
    all_rows, all_where = np.concatenate(rows), np.concatenate(where)
    _, first = np.unique(all_rows, return_index=True)
    return all_rows[first], all_where[first]
