"""The model: 3D Gaussians in the parameterisation of 3DGS, sky last."""

import math
from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

PARAMETERS = ("means", "quats", "scales", "opacities", "sh0", "shN")  # of `Gaussians`, in their order
EXACT = "exact"  # in tensors by name, where `Gaussians.exact`
SH_REST = 15  # coefficients of degrees 1 to 3
SH_C0 = 0.28209479177387814  # the constant spherical harmonic, 1 / (2 √π)


def logit(probability: float) -> float:
    """The stored form of an opacity in [0, 1)."""
    return math.log(probability / (1 - probability)) if probability > 0 else -math.inf


@dataclass(frozen=True, eq=False)
class Gaussians:
    """N Gaussians as they are stored and optimised; the last `sky` of them are the sky sphere (eq. 3).

    >>> import panolog
    >>> model = panolog.initial_gaussians(panolog.read_scene(SCENE))
    >>> faint = model.select(model.opacities < 0)
    >>> len(faint), {name: tuple(tensor.shape) for name, tensor in faint.tensors().items()}["sh0"]
    (50, (50, 1, 3))
    """

    means: Tensor  # (N, 3) world units
    quats: Tensor  # (N, 4) w x y z, not necessarily unit
    scales: Tensor  # (N, 3) log of world units
    opacities: Tensor  # (N,) logit
    sh0: Tensor  # (N, 1, 3) spherical harmonics of degree 0
    shN: Tensor  # (N, 15, 3) spherical harmonics of degrees 1 to 3  # noqa: N815
    sky: int = 0  # how many at the end are sky
    exact: bool = False  # whether they are seen along the rays of pixels, or as affine splats (eq. 2)

    def __len__(self) -> int:
        return len(self.means)

    @property
    def scene(self) -> slice:
        """The rows that are scene, not sky."""
        return slice(0, len(self) - self.sky)

    def tensors(self) -> dict[str, Tensor]:
        """The parameters by name, in the order of the fields."""
        return {name: getattr(self, name) for name in PARAMETERS}

    def with_tensors(self, tensors: Mapping[str, Tensor], sky: int | None = None) -> "Gaussians":
        """Gaussians of the same kind. Args: all parameters by name; how many are sky, as many if None."""
        return Gaussians(**tensors, sky=self.sky if sky is None else sky, exact=self.exact)

    def to(self, device: torch.device | str) -> "Gaussians":
        """These Gaussians on another device."""
        return self.with_tensors({name: tensor.to(device) for name, tensor in self.tensors().items()})

    def select(self, keep: Tensor) -> "Gaussians":
        """The rows of `keep`: a mask (N,) of bool. The order stays, so sky stays last."""
        kept = {name: tensor[keep] for name, tensor in self.tensors().items()}
        return self.with_tensors(kept, sky=int(keep[len(self) - self.sky :].sum()))


def concatenate(first: Gaussians, second: Gaussians) -> Gaussians:
    """The Gaussians of both, in order. Only the second may have sky, because sky is always last."""
    if first.sky:
        raise ValueError("the first part has sky Gaussians; sky must be last")
    both = {name: torch.cat([tensor, getattr(second, name)]) for name, tensor in first.tensors().items()}
    return first.with_tensors(both, sky=second.sky)
