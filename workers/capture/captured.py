"""What is known of how panoramas were captured, besides what their scene says; how later stages get it."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from panolog.scene.errors import RunError
from panolog.scene.files import atomic
from panolog.scene.model import Panorama, Scene

Array: TypeAlias = NDArray[Any]


@dataclass(frozen=True, eq=False, kw_only=True)
class Captured:
    """Exposure, pose and movers of some panoramas; a part that was not learnt is None."""

    rows: NDArray[np.int64]  # (V,) of scene.panoramas, ascending
    exposure: NDArray[np.float64] | None = None  # (V, 2, 3) as `Panorama.exposure`
    poses: NDArray[np.float64] | None = None  # (V, 3, 4) rotation and translation, as `Panorama`
    movers: NDArray[np.bool_] | None = None  # (V, h, w) as `Panorama.movers`
    at_bound: NDArray[np.bool_] | None = None  # (V,) whether a pose would have moved farther
    residuals: NDArray[np.float64] | None = None  # (V,) as `Panorama.residual`, NaN where it is not known
    given: NDArray[np.float64] | None = None  # (V, 3, 4) the poses before an adjustment
    points: NDArray[np.float64] | None = None  # (P, 3) of the scene, after an adjustment

    def applied(self, scene: Scene) -> Scene:
        """The scene with this in its panoramas."""
        panoramas = list(scene.panoramas)
        for at, row in enumerate(self.rows.tolist()):
            panoramas[row] = self._applied(panoramas[row], at)
        points = scene.points if self.points is None else self.points
        return replace(scene, panoramas=tuple(panoramas), points=points)

    def _applied(self, panorama: Panorama, at: int) -> Panorama:
        if self.exposure is not None:
            panorama = replace(panorama, exposure=self.exposure[at])
        if self.poses is not None:
            pose = self.poses[at]
            panorama = replace(panorama, rotation=pose[:, :3].copy(), translation=pose[:, 3].copy())
        if self.residuals is not None and np.isfinite(self.residuals[at]):
            panorama = replace(panorama, residual=float(self.residuals[at]))
        if self.movers is not None and self.movers[at].any():
            panorama = replace(panorama, movers=self.movers[at])
        return panorama

    def save(self, path: Path) -> None:
        """Writes it by atomic rename. Raises OSError if the disk takes no file."""
        parts = {name: part for name, part in vars(self).items() if part is not None}
        with atomic(path) as temporary, temporary.open("wb") as file:
            np.savez_compressed(file, allow_pickle=False, **parts)

    @staticmethod
    def load(path: Path) -> "Captured":
        """The inverse of `save`. Raises RunError if the file is damaged."""
        try:
            with np.load(path, allow_pickle=False) as file:
                return Captured(**{name: file[name] for name in file.files})
        except (OSError, ValueError, TypeError, KeyError, EOFError) as error:
            raise RunError(f"{path}: is damaged ({error}); train Stage I again in a new run") from error


def joined(parts: Sequence[Captured]) -> Captured:
    """What districts have learnt as one: of a panorama in several the mean, and what any calls a mover.

    Poses are averaged as matrices and made rotations again.
    """
    rows = np.unique(np.concatenate([part.rows for part in parts]))
    where = [np.searchsorted(rows, part.rows) for part in parts]
    count = np.zeros(len(rows))
    for at in where:
        count[at] += 1

    def total(name: str) -> Array | None:
        values = [getattr(part, name) for part in parts]
        if any(value is None for value in values):
            return None
        sums = np.zeros((len(rows), *values[0].shape[1:]))
        for at, value in zip(where, values, strict=True):
            sums[at] += value
        return sums

    exposure, poses, movers, bounded = map(total, ("exposure", "poses", "movers", "at_bound"))
    return Captured(
        rows=rows,
        exposure=None if exposure is None else exposure / count[:, None, None],
        poses=None if poses is None else _orthogonal(poses / count[:, None, None]),
        movers=None if movers is None else movers > 0,
        at_bound=None if bounded is None else bounded > 0,
    )


def _orthogonal(poses: NDArray[np.float64]) -> NDArray[np.float64]:
    """Poses (V, 3, 4) with the nearest rotations."""
    u, _, v = np.linalg.svd(poses[:, :, :3])
    turned = u @ v
    return np.concatenate([turned, poses[:, :, 3:]], axis=2)
