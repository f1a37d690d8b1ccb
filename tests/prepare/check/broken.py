"""The town, broken in the ways in which imports go wrong."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from panolog.scene.colmap import Observations, read_colmap, write_colmap

Array = NDArray[np.float64]
FLIP = np.diag([1.0, -1.0, -1.0])
MIRROR = np.diag([-1.0, 1.0, 1.0])
HALF_TURN = np.diag([-1.0, 1.0, -1.0])


@dataclass(frozen=True, eq=False)
class Town:
    """What a scene's files hold."""

    names: tuple[str, ...]
    rotations: Array  # (K, 3, 3)
    centers: Array  # (K, 3)
    points: Array  # (P, 3)
    colors: NDArray[np.uint8]
    observations: tuple[Observations, ...]
    width: int
    pictures: tuple[NDArray[np.uint8], ...]  # BGR

    def posed(self, rotations: Array, centers: Array | None = None) -> "Town":
        return replace(self, rotations=rotations, centers=self.centers if centers is None else centers)


def read_town(folder: Path) -> Town:
    model = read_colmap(folder / "sparse" / "0")
    images = sorted(model.images, key=lambda image: image.name)
    return Town(
        names=tuple(image.name for image in images),
        rotations=np.stack([image.rotation for image in images]),
        centers=np.stack([-image.rotation.T @ image.translation for image in images]),
        points=model.points,
        colors=model.colors,
        observations=tuple((image.points, image.pixels) for image in images),
        width=images[0].camera.width,
        pictures=tuple(np.asarray(cv2.imread(str(folder / "images" / image.name))) for image in images),
    )


def write_town(town: Town, folder: Path, *, tracks: bool) -> Path:
    (folder / "images").mkdir(parents=True)
    for name, picture in zip(town.names, town.pictures, strict=True):
        cv2.imwrite(str(folder / "images" / name), picture)
    none: Observations = (np.empty(0, np.int64), np.empty((0, 2)))
    write_colmap(
        folder / "sparse" / "0",
        [
            (name, rotation, -rotation @ center)
            for name, rotation, center in zip(town.names, town.rotations, town.centers, strict=True)
        ],
        width=town.width,
        height=town.width // 2,
        points=town.points,
        colors=town.colors,
        observations=town.observations if tracks else [none] * len(town.names),
    )
    return folder


def _moved(town: Town, pixels: float) -> Town:
    """Observations that lie elsewhere by so many pixels, each way."""
    return replace(town, observations=tuple((rows, where + pixels) for rows, where in town.observations))


def opengl(town: Town) -> Town:
    """Camera-to-world matrices with y up and z backward, inverted as if they were ours."""
    return town.posed(FLIP @ town.rotations)


def z_up_points(town: Town) -> Town:
    """The points were turned to another up, the poses were not."""
    return replace(town, points=town.points @ np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]).T)


def mirrored(town: Town) -> Town:
    """The world was mirrored, and the poses made rotations again."""
    return replace(
        town,
        rotations=MIRROR @ town.rotations @ MIRROR,
        centers=town.centers @ MIRROR,
        points=town.points @ MIRROR,
    )


def half_turn(town: Town) -> Town:
    """Longitude 0 is taken to be at the seam."""
    return town.posed(HALF_TURN @ town.rotations)


def inverse(town: Town) -> Town:
    """Camera-to-world poses, written as world-to-camera."""
    return town.posed(
        town.rotations.transpose(0, 2, 1), -np.einsum("kij,kj->ki", town.rotations, town.centers)
    )


def centres(town: Town) -> Town:
    """Camera centres, written as translations."""
    return town.posed(town.rotations, -np.einsum("kji,kj->ki", town.rotations, town.centers))


def half_pixel_poses(town: Town) -> Town:
    """Poses and tracks with pixel centres at whole numbers: as openMVG writes them."""
    turn = Rotation.from_euler("y", -np.pi / town.width).as_matrix()
    return _moved(town.posed(turn @ town.rotations), -0.5)


def half_pixel_tracks(town: Town) -> Town:
    """The poses are right, the observations were written with pixel centres at whole numbers."""
    return _moved(town, -0.5)


def shuffled(town: Town) -> Town:
    """Three pictures have each other's names, and so poses."""
    order = list(range(len(town.pictures)))
    order[1], order[4], order[6] = order[4], order[6], order[1]
    return replace(town, pictures=tuple(town.pictures[index] for index in order))


def other_pictures(town: Town) -> Town:
    """Pictures of another place: noise."""
    random = np.random.default_rng(3)
    noise = tuple(random.integers(0, 256, picture.shape, np.uint8) for picture in town.pictures)
    return replace(town, pictures=noise)


def far_off(town: Town) -> Town:
    """Poses that fit in no convention: each is turned by some degrees of its own."""
    turns = Rotation.from_rotvec(np.random.default_rng(5).normal(0, 0.15, (len(town.names), 3))).as_matrix()
    return town.posed(turns @ town.rotations)


Breakage = Callable[[Town], Town]
