"""The model: 3D Gaussians in the parameterisation of 3DGS, sky last."""

import math
from dataclasses import dataclass, fields, replace

import torch
from torch import Tensor

SH_REST = 15  # coefficients of degrees 1 to 3


def logit(probability: float) -> float:
    """The stored form of an opacity in [0, 1)."""
    return math.log(probability / (1 - probability)) if probability > 0 else -math.inf


@dataclass(frozen=True, eq=False)
class Gaussians:
    """N Gaussians as they are stored and optimised; the last `sky` of them are the sky sphere (eq. 3)."""

    means: Tensor  # (N, 3) world units
    quats: Tensor  # (N, 4) w x y z, not necessarily unit
    scales: Tensor  # (N, 3) log of world units
    opacities: Tensor  # (N,) logit
    sh0: Tensor  # (N, 1, 3) spherical harmonics of degree 0
    shN: Tensor  # (N, 15, 3) spherical harmonics of degrees 1 to 3  # noqa: N815
    sky: int = 0  # how many at the end are sky

    def __len__(self) -> int:
        return len(self.means)

    @property
    def scene(self) -> slice:
        """The rows that are scene, not sky."""
        return slice(0, len(self) - self.sky)

    def tensors(self) -> dict[str, Tensor]:
        """The parameters by name, in the order of the fields."""
        return {field.name: getattr(self, field.name) for field in fields(self) if field.name != "sky"}

    def to(self, device: torch.device | str) -> "Gaussians":
        """The same Gaussians on another device."""
        moved = {name: tensor.to(device) for name, tensor in self.tensors().items()}
        return replace(self, **moved, sky=self.sky)

    def select(self, keep: Tensor) -> "Gaussians":
        """The rows of `keep`: a mask (N,) of bool. The order stays, so sky stays last."""
        return replace(
            self,
            **{name: tensor[keep] for name, tensor in self.tensors().items()},
            sky=int(keep[len(self) - self.sky :].sum()),
        )


def concatenate(first: Gaussians, second: Gaussians) -> Gaussians:
    """Both, in order. Only the second may have sky, because sky is always last."""
    if first.sky:
        raise ValueError("the first part has sky Gaussians; sky must be last")
    both = {name: torch.cat([tensor, getattr(second, name)]) for name, tensor in first.tensors().items()}
    return Gaussians(**both, sky=second.sky)
