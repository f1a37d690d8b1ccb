"""The known scene in the formats that hold a COLMAP model."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from panolog.prepare.importers.interface import ImportSource
from tests.prepare.importers.files import write_colmap_text, write_split
from tests.prepare.importers.known import Known, make_known


def _sphere_model(folder: Path, known: Known, size: int, suffix: str = ".png") -> None:
    """SphereSfM's model of panoramas `size` pixels wide, camera 0."""
    images = [
        (
            str(Path(name).with_suffix(suffix)),
            0,
            known.rotations[index],
            known.translations[index],
            known.pixels[index] * size / known.width,
            (known.observed[index] + 1).tolist(),
        )
        for index, name in enumerate(known.names)
    ]
    write_colmap_text(folder, [f"0 SPHERE {size} {size // 2} 1.0 {size / 2} {size / 4}"], images, known)


def spheresfm(folder: Path) -> tuple[Known, ImportSource]:
    known = make_known(folder)
    _sphere_model(folder / "sparse" / "0", known, known.width)
    return known, ImportSource(folder)


def egonerf(folder: Path) -> tuple[Known, ImportSource]:
    """The model is of JPEGs twice as wide as the PNGs that are there."""
    known = make_known(folder, images="imgs")
    (folder / "imgs" / "mask.png").write_bytes(b"not a panorama")
    _sphere_model(folder / "output_dir" / "colmap", known, 2 * known.width, ".jpg")
    write_split(folder, known)
    return known, ImportSource(folder)


def panorama_sfm(folder: Path, pitches: Sequence[float] = (-35.0, 0.0, 35.0)) -> tuple[Known, ImportSource]:
    """The faces of pycolmap's panorama_sfm, of 90 degrees and 16 pixels wide; they see what lies within them.

    Args: pitches, in degrees; there are four yaws for each.
    """
    known = make_known(folder, images="panoramas")
    images = []
    yaws = np.arange(4) * 90.0
    for number, (pitch, yaw) in enumerate((p, y + 45.0 * (p > 0)) for p in pitches for y in yaws):
        face = Rotation.from_euler("XY", [-pitch, -yaw], degrees=True).as_matrix()
        for index, name in enumerate(known.names):
            rotation = face @ known.rotations[index]
            translation = face @ known.translations[index]
            rows = known.observed[index]
            rays = known.points[rows] @ rotation.T + translation
            within = (rays[:, 2] > 0) & (np.abs(rays[:, :2]).max(axis=1) < rays[:, 2])
            pixels = 8.0 * rays[within, :2] / rays[within, 2:] + 8.0
            seen = (rows[within] + 1).tolist()
            images.append((f"pano_camera{number}/{name}", 1, rotation, translation, pixels, seen))
    write_colmap_text(folder / "sparse" / "0", ["1 SIMPLE_PINHOLE 16 16 8.0 8.0 8.0"], images, known)
    return known, ImportSource(folder, images=folder / "panoramas")
