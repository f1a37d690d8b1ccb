"""The most important Gaussians of a large model, as covariances and plain colours."""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from panolog.scene.gaussians import Gaussians

Chunks = Callable[[], Iterator[Gaussians]]  # reads the Gaussians of a model in order, again at each call
RADIUS = 5.0  # of the scene as it is shown: viewers keep covariances in half precision
_SAMPLE = 100_000  # Gaussians, about, from which the extent of a model is estimated
_SH0 = 0.5 / math.sqrt(math.pi)  # the constant spherical harmonic


@dataclass(frozen=True, eq=False)
class Splats:
    """S Gaussians, moved and scaled so that half of the scene lies within `RADIUS` of the origin."""

    centers: NDArray[np.float32]  # (S, 3)
    covariances: NDArray[np.float32]  # (S, 3, 3)
    colors: NDArray[np.float32]  # (S, 3) in [0, 1], the same from every direction
    opacities: NDArray[np.float32]  # (S, 1) in [0, 1]
    middle: NDArray[np.float32]  # (3,) world units: the origin here
    scale: float  # of world units
    sky: int  # how many of the last are sky
    total: int  # Gaussians of the model

    def __len__(self) -> int:
        return len(self.centers)

    def place(self, world: NDArray[np.floating]) -> NDArray[np.floating]:
        """(..., 3) points (..., 3) of the world in these coordinates."""
        return (world - self.middle) * self.scale


def pick(chunks: Chunks, count: int, most: int) -> Splats:
    """The `most` Gaussians of a model that cover most, in three passes over it in pieces.

    What one covers is its opacity times its solid angle from the middle of the scene, so that near Gaussians
    and sky are comparable; those closer than the median distance count as if they were at that distance.

    Args: chunks of the model; count of its Gaussians, at least one.
    """
    middle, radius = _place(chunks(), count)
    kept = np.ones(count, bool)
    if count > most:
        covers = np.concatenate([_cover(piece, middle, radius) for piece in chunks()])
        kept[np.argpartition(covers, count - most)[: count - most]] = False
    scale = RADIUS / radius
    parts, start, sky = [], 0, 0
    for piece in chunks():
        keep = torch.from_numpy(kept[start : start + len(piece)])
        start += len(piece)
        kept_piece = piece.select(keep)
        sky += kept_piece.sky
        parts.append(_convert(kept_piece, middle, scale))
    centers, covariances, colors, opacities = map(np.concatenate, zip(*parts, strict=True))
    return Splats(centers, covariances, colors, opacities, middle.numpy(), scale, sky, count)


def _place(chunks: Iterator[Gaussians], count: int) -> tuple[torch.Tensor, float]:
    """(3,) the median of the scene's means, and the median distance from it; of a sample."""
    step = max(1, count // _SAMPLE)
    sample, sky = [], []
    for piece in chunks:
        sample.append(piece.means[piece.scene][::step])
        sky.append(piece.means[len(piece) - piece.sky :][::step])
    means = torch.cat(sample)
    if not len(means):  # sky alone
        means = torch.cat(sky)
    middle = means.median(dim=0).values
    radius = float((means - middle).norm(dim=1).median())
    return middle, radius or 1.0


def _cover(piece: Gaussians, middle: torch.Tensor, radius: float) -> NDArray[np.float32]:
    """(n,) how much each covers: see `pick`."""
    area = (piece.scales.sum(dim=1) - piece.scales.min(dim=1).values).exp()
    distance = (piece.means - middle).norm(dim=1).clamp(min=radius)
    covers: NDArray[np.float32] = (piece.opacities.sigmoid() * area / distance**2).numpy()
    return covers


def _convert(piece: Gaussians, middle: torch.Tensor, scale: float) -> tuple[NDArray[np.float32], ...]:
    """Centres (n, 3), covariances (n, 3, 3), colours (n, 3) and opacities (n, 1)."""
    axes = _rotations(piece.quats) * (piece.scales.exp() * scale)[:, None, :]
    columns = (
        (piece.means - middle) * scale,
        axes @ axes.transpose(1, 2),
        (piece.sh0[:, 0] * _SH0 + 0.5).clamp(0, 1),
        piece.opacities.sigmoid()[:, None],
    )
    return tuple(column.numpy() for column in columns)


def _rotations(quats: torch.Tensor) -> torch.Tensor:
    """(n, 3, 3) the rotations of quaternions (n, 4), w x y z, of any length but zero."""
    w, x, y, z = torch.nn.functional.normalize(quats, dim=1).unbind(dim=1)
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    return torch.stack([torch.stack(row, dim=1) for row in rows], dim=1)
