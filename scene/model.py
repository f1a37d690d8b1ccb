"""What a scene is, once read: posed panoramas, a sparse cloud and a split. No file is decoded here."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from panolog.scene.files import stem_of

Vector: TypeAlias = tuple[float, float, float]
NO_OFFSET: Vector = (0.0, 0.0, 0.0)
_PLAIN = 2.0  # of 255: standard deviation of each channel, below which a cloud says nothing of colours


def of_one_color(colors: NDArray[np.integer] | NDArray[np.floating]) -> bool:
    """Whether colours (N, 3) of 0 to 255, one at least, are about the same, as of a cloud that has none."""
    return float(colors.std(axis=0).max()) < _PLAIN


@dataclass(frozen=True, eq=False)
class Panorama:
    """One posed equirectangular image.

    Camera axes: x right, y down, z forward. The pose is world-to-camera: X_cam = rotation @ X + translation.
    """

    name: str  # relative to the image folder, the key of the split and of every report
    image: Path
    rotation: NDArray[np.float64]  # (3, 3)
    translation: NDArray[np.float64]  # (3,)
    observed: NDArray[np.int64]  # (M,) rows of Scene.points that this panorama has seen
    mask: Path | None = None  # 8 bit, 0 = ignore (operator, tripod, movers)
    sky_mask: Path | None = None  # 8 bit, 255 foreground, 0 sky
    depth: Path | None = None  # 16 bit, monocular radial inverse depth up to an affine, 0 = sky
    depth_affine: tuple[float, float] | None = None  # (scale, offset) of eq. 4, if the scene has it
    exposure: NDArray[np.float64] | None = None  # (2, 3) RGB: ln of gains in linear light, black levels
    residual: float | None = None  # median error of its points' reprojections, pixels of Scene.width
    movers: NDArray[np.bool_] | None = None  # (h, w) cells of the picture that show what is not of the place
    transparent: bool = False  # whether its file has an alpha channel, which is a mask as well

    @property
    def files(self) -> tuple[Path, ...]:
        """The image, and the layers that there are."""
        layers = (self.mask, self.sky_mask, self.depth)
        return (self.image, *(layer for layer in layers if layer is not None))

    @property
    def masked(self) -> bool:
        """Whether some of its pixels may be ignored."""
        return self.mask is not None or self.movers is not None or self.transparent

    @property
    def stem(self) -> str:
        """The name without its extension: what split files and depth parameters use."""
        return stem_of(self.name)

    @cached_property
    def center(self) -> NDArray[np.float64]:
        """(3,) camera centre C = -Rᵀt in world units."""
        return -self.rotation.T @ self.translation


@dataclass(frozen=True, eq=False)
class Scene:
    """A scene as the trainers need it. `scene.read.read_scene` makes one and checks all of it."""

    root: Path
    width: int  # pixels of the source panoramas; height is width / 2
    height: int
    panoramas: tuple[Panorama, ...]  # in the natural order of their names
    points: NDArray[np.float64]  # (P, 3) sparse cloud, world units
    colors: NDArray[np.uint8]  # (P, 3) RGB
    train: tuple[int, ...]  # rows of panoramas
    test: tuple[int, ...]  # held out; empty if all are to train
    fingerprint: str  # sha256 over poses, points, split and the names, sizes of the files
    offset: Vector = NO_OFFSET  # to be added to coordinates for those of its COLMAP model: see `find_offset`

    @cached_property
    def centers(self) -> NDArray[np.float64]:
        """(K, 3) camera centres of all panoramas in world units."""
        return np.stack([panorama.center for panorama in self.panoramas])

    @cached_property
    def poses(self) -> NDArray[np.float64]:
        """(K, 3, 4) rotation and translation of all panoramas."""
        return np.stack([np.column_stack([each.rotation, each.translation]) for each in self.panoramas])

    def without_holdout(self) -> "Scene":
        """This scene with its held-out panoramas among those that train, so that none can be measured on."""
        return replace(self, train=tuple(sorted({*self.train, *self.test})), test=())

    def without_points(self) -> "Scene":
        """This scene without the sparse cloud: what all tasks of a scene share."""
        nothing = np.zeros(0, np.int64)
        panoramas = tuple(replace(panorama, observed=nothing) for panorama in self.panoramas)
        return replace(self, panoramas=panoramas, points=self.points[:0], colors=self.colors[:0])

    def cloud_of(self, rows: Iterable[int]) -> "Cloud":
        """What some panoramas have observed of the sparse cloud; all of it where they have observed nothing.

        The point that is farthest from the training cameras is always in it: the sky's radius comes from it.
        """
        seen = {row: self.panoramas[row].observed for row in rows}
        chosen = np.unique(np.concatenate([np.zeros(0, np.int64), *seen.values()]))
        chosen = np.union1d(chosen, self._farthest) if len(chosen) else np.arange(len(self.points))
        observed = {row: np.searchsorted(chosen, points) for row, points in seen.items()}
        return Cloud(self.points[chosen], self.colors[chosen], observed)

    @cached_property
    def _farthest(self) -> NDArray[np.int64]:
        """(1,) the row of the point farthest from the training cameras' centroid; (0,) without points."""
        apart = np.linalg.norm(self.points - self.centers[list(self.train)].mean(axis=0), axis=1)
        return np.array([apart.argmax()] if len(apart) else [], np.int64)


@dataclass(frozen=True, eq=False)
class Cloud:
    """A part of a scene's sparse cloud, and which panoramas have observed it."""

    points: NDArray[np.float64]  # (P, 3) world units
    colors: NDArray[np.uint8]  # (P, 3) RGB
    observed: Mapping[int, NDArray[np.int64]]  # (M,) rows of `points` by row of Scene.panoramas

    def within(self, scene: Scene) -> Scene:
        """A scene with this cloud instead of its own."""
        panoramas = list(scene.panoramas)
        for row, points in self.observed.items():
            panoramas[row] = replace(panoramas[row], observed=points)
        return replace(scene, panoramas=tuple(panoramas), points=self.points, colors=self.colors)
