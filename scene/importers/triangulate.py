"""Points for formats with poses only: features, matches between neighbours, triangulation, poses kept."""

import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from panolog.scene.errors import InputError
from panolog.scene.importers.axes import Array
from panolog.scene.importers.parsed import PosedImage, Sightings

if TYPE_CHECKING:
    import pycolmap

NEIGHBOURS = 8  # other panoramas, the nearest ones, that each is matched with
LEAST = 20  # points that three panoramas see, with which poses can be believed
SHARE = (
    0.25  # of all points: with wrong poses, rays of two panoramas may meet by chance, those of three do not
)
_MOST_FEATURES = 8192  # of a panorama
Found = tuple[Array, NDArray[np.uint8], list[Sightings]]  # (P, 3) points, (P, 3) RGB, what each image sees


def triangulate(where: Path, images: Sequence[PosedImage], size: tuple[int, int]) -> Found:
    """Points that panoramas of that size (width, height) see, in the world of their poses.

    Args:
        where: the source, for messages.
        images: at least two, with unique names.
        size: of the panoramas, in pixels.

    Raises:
        InputError: too few points that fit: the poses do not fit the panoramas, or these share too little.
    """
    import pycolmap  # noqa: PLC0415

    level, pycolmap.logging.minloglevel = pycolmap.logging.minloglevel, pycolmap.logging.FATAL.value
    try:
        with tempfile.TemporaryDirectory() as name:
            folder = Path(name)
            _match(folder, images)
            model = _model(folder, images, size)
            (folder / "model").mkdir()
            model = pycolmap.triangulate_points(model, folder / "db", folder / "images", folder / "model")
    except (RuntimeError, ValueError) as error:
        reason = str(error).strip().split("\n")[0][:120]
        raise InputError(f"{where}: has no points, and none were found ({reason}); give --points") from error
    finally:
        pycolmap.logging.minloglevel = level
    found = _found(model, images, size)
    views = np.bincount(np.concatenate([rows for rows, _ in found[2]]), minlength=len(found[0]))
    firm = int((views >= min(3, len(images))).sum())
    if firm < max(LEAST, SHARE * len(views)):
        raise InputError(
            f"{where}: has no points, and with its poses only {firm} could be triangulated: they do not fit "
            "the panoramas, or these share too little; give a cloud with --points"
        )
    return found


def _match(folder: Path, images: Sequence[PosedImage]) -> None:
    """Features of all panoramas and matches of neighbours, in the database folder/db."""
    import pycolmap  # noqa: PLC0415

    (folder / "images").mkdir()
    names = _names(images)
    for name, image in zip(names, images, strict=True):
        (folder / "images" / name).symlink_to(image.file.resolve())
    extraction = pycolmap.FeatureExtractionOptions()
    extraction.sift.max_num_features = _MOST_FEATURES
    reader = pycolmap.ImageReaderOptions()
    reader.camera_model = "EQUIRECTANGULAR"
    pycolmap.extract_features(
        folder / "db",
        folder / "images",
        camera_mode=pycolmap.CameraMode.SINGLE,
        reader_options=reader,
        extraction_options=extraction,
    )
    pairs = folder / "pairs.txt"
    pairs.write_text("".join(f"{names[a]} {names[b]}\n" for a, b in _neighbours(images)))
    pairing = pycolmap.ImportedPairingOptions()
    pairing.match_list_path = str(pairs)
    pycolmap.match_image_pairs(folder / "db", pairing_options=pairing)


def _names(images: Sequence[PosedImage]) -> list[str]:
    """Names without blanks, which separate them in a list of pairs."""
    return [f"{index:06d}{image.file.suffix}" for index, image in enumerate(images)]


def _neighbours(images: Sequence[PosedImage]) -> list[tuple[int, int]]:
    """Pairs of images whose cameras are near each other."""
    centers = np.stack([-image.rotation.T @ image.translation for image in images])
    pairs = set()
    for a, center in enumerate(centers):
        order = np.argsort(np.linalg.norm(centers - center, axis=1), kind="stable")
        pairs |= {(min(a, b), max(a, b)) for b in order[: NEIGHBOURS + 1].tolist() if b != a}
    return sorted(pairs)


def _model(folder: Path, images: Sequence[PosedImage], size: tuple[int, int]) -> "pycolmap.Reconstruction":
    """The poses as a model with the ids of the database."""
    import pycolmap  # noqa: PLC0415

    model = pycolmap.Reconstruction()
    with pycolmap.Database.open(folder / "db") as database:
        ids = {image.name: (image.image_id, image.camera_id) for image in database.read_all_images()}
    width, height = (float(length) for length in size)
    for number in sorted({camera for _, camera in ids.values()}):
        camera = pycolmap.Camera(
            camera_id=number, model="EQUIRECTANGULAR", width=size[0], height=size[1], params=[width, height]
        )
        model.add_camera_with_trivial_rig(camera)
    for name, image in zip(_names(images), images, strict=True):
        number, owner = ids[name]
        posed = pycolmap.Image(name=name, camera_id=owner, image_id=number)
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(image.rotation), image.translation)
        model.add_image_with_trivial_frame(posed, pose)
    return model


def _found(model: "pycolmap.Reconstruction", images: Sequence[PosedImage], size: tuple[int, int]) -> Found:
    """Points by id, and where they were seen."""
    ids = sorted(model.points3D)
    rows = {number: row for row, number in enumerate(ids)}
    by_name = {str(image.name): image for image in model.images.values()}
    sightings: list[Sightings] = []
    for name in _names(images):
        seen = [point for point in by_name[name].points2D if point.has_point3D()]
        where = np.array([point.xy for point in seen], np.float64).reshape(-1, 2) / size
        sightings.append((np.array([rows[point.point3D_id] for point in seen], np.int64), where))
    points = np.array([model.points3D[number].xyz for number in ids], np.float64).reshape(-1, 3)
    colors = np.array([model.points3D[number].color for number in ids], np.uint8).reshape(-1, 3)
    return points, colors, sightings
