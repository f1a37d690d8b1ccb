"""Points for formats with poses only: features, matches between neighbours, triangulation, poses kept."""

import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pycolmap

from panolog.prepare.panorama_files import PanoramaFile
from panolog.prepare.sfm.features import find_features
from panolog.prepare.sfm.pairs import match_pairs
from panolog.prepare.sfm.reconstruct import max_error
from panolog.prepare.sfm.sparse_model import SparseModel, from_colmap
from panolog.prepare.sfm.trajectory import near_pairs
from panolog.prepare.sfm.workspace import Workspace, silence_colmap
from panolog.scene.errors import SceneError
from panolog.scene.write import PosedImage, StageProgress

NEIGHBOURS = 8  # nearest panoramas that each is matched with
LEAST = 20  # points seen by three panoramas, for poses to be accepted
SHARE = 0.25  # of all points: with wrong poses, only rays of two panoramas may meet by chance


def triangulate(
    where: Path, images: Sequence[PosedImage], size: tuple[int, int], progress: StageProgress
) -> SparseModel:
    """Points that panoramas of that size (width, height) see, in the world of their poses.

    Args:
        where: the source, for messages.
        size: of the panoramas, in pixels.
        progress: called after each step of the stages "features", "matches" and "points".

    Raises SceneError: too few points that fit: the poses do not fit the panoramas, or these share too little.
    """
    with tempfile.TemporaryDirectory() as name, silence_colmap():
        panoramas = tuple(PanoramaFile(where, image.name, image.file) for image in images)
        work = Workspace(Path(name), panoramas)
        work.open(None)
        find_features(work, [[] for _ in panoramas], progress)
        ids = work.ids()
        pairs = [(ids[a], ids[b]) for a, b in neighbours(images)]
        match_pairs(work, sorted(pairs), max_error(size[0]), progress)
        progress("points", 0, len(images))
        try:
            model = points_of(work, images, size)
        except (RuntimeError, ValueError) as error:
            reason = str(error).strip().split("\n")[0][:120]
            raise SceneError(
                f"{where}: has no points, and none were found ({reason}); give --points"
            ) from error
        found = from_colmap(model, work.numbers, size)
        progress("points", len(images), len(images))
    firm = found.points_seen_by(min(3, len(images)))
    if firm < max(LEAST, SHARE * len(found.points)):
        raise SceneError(
            f"{where}: has no points, and with its poses only {firm} could be triangulated: they do not fit "
            "the panoramas, or these share too little; give a cloud with --points"
        )
    return found


def neighbours(images: Sequence[PosedImage]) -> list[tuple[int, int]]:
    """Pairs of rows, ascending, of images whose cameras are near each other."""
    return near_pairs(np.stack([-image.rotation.T @ image.translation for image in images]), NEIGHBOURS)


def points_of(
    work: Workspace, images: Sequence[PosedImage], size: tuple[int, int]
) -> pycolmap.Reconstruction:
    """The poses of the first panoramas of a database, and the points that its pairs of them see.

    Raises RuntimeError or ValueError: pycolmap finds none.
    """
    work.clear_models()
    model = _model(work, images, size)
    return pycolmap.triangulate_points(model, work.database, work.images, work.models)


def _model(work: Workspace, images: Sequence[PosedImage], size: tuple[int, int]) -> pycolmap.Reconstruction:
    """The poses as a model with the ids of the database."""
    model = pycolmap.Reconstruction()
    with pycolmap.Database.open(work.database) as database:
        owners = {image.image_id: image.camera_id for image in database.read_all_images()}
    params = [float(length) for length in size]
    for number in sorted(set(owners.values())):
        camera = pycolmap.Camera(
            camera_id=number, model="EQUIRECTANGULAR", width=size[0], height=size[1], params=params
        )
        model.add_camera_with_trivial_rig(camera)
    for name, number, image in zip(work.numbers, work.ids(), images, strict=False):
        posed = pycolmap.Image(name=name, camera_id=owners[number], image_id=number)
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(image.rotation), image.translation)
        model.add_image_with_trivial_frame(posed, pose)
    return model
