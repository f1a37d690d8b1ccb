"""Gaussians in training: the parameters with their Adam moments, which stay in step when rows come and go."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields

import torch
from torch import Tensor

from panolog.renderer.adam import adam_
from panolog.scene.gaussians import Gaussians


@dataclass(eq=False)
class Trainee:
    """N Gaussians and the first and second moments of each parameter, all without autograd history."""

    gaussians: Gaussians
    exp_avg: dict[str, Tensor]  # shaped as the parameters
    exp_avg_sq: dict[str, Tensor]

    @staticmethod
    def fresh(gaussians: Gaussians) -> "Trainee":
        """Training from here on: all moments zero. The tensors are copied: steps change them in place."""
        tensors = {name: tensor.detach().clone() for name, tensor in gaussians.tensors().items()}
        return Trainee(
            Gaussians(**tensors, sky=gaussians.sky),
            {name: torch.zeros_like(tensor) for name, tensor in tensors.items()},
            {name: torch.zeros_like(tensor) for name, tensor in tensors.items()},
        )

    @staticmethod
    def of(tensors: Mapping[str, Tensor]) -> "Trainee":
        """From what `tensors` gave, sharing memory: steps change it in place."""
        names = [field.name for field in fields(Gaussians) if field.name != "sky"]
        return Trainee(
            Gaussians(**{name: tensors[name] for name in names}, sky=int(tensors["sky"])),
            {name: tensors[f"exp_avg.{name}"] for name in names},
            {name: tensors[f"exp_avg_sq.{name}"] for name in names},
        )

    def tensors(self) -> dict[str, Tensor]:
        """All of it by name, sharing memory."""
        moments = {f"exp_avg.{name}": tensor for name, tensor in self.exp_avg.items()}
        moments |= {f"exp_avg_sq.{name}": tensor for name, tensor in self.exp_avg_sq.items()}
        return {**self.gaussians.tensors(), **moments, "sky": torch.tensor(self.gaussians.sky)}

    def leaves(self, sh_degree: int) -> Gaussians:
        """The Gaussians as leaves of autograd, sharing memory. At degree 0 `shN` gets no gradient."""
        leaves = {
            name: tensor.detach().requires_grad_(name != "shN" or sh_degree > 0)
            for name, tensor in self.gaussians.tensors().items()
        }
        return Gaussians(**leaves, sky=self.gaussians.sky)

    def step(
        self, gradients: Mapping[str, Tensor], rates: Mapping[str, float], rows: Mapping[str, int], step: int
    ) -> None:
        """One Adam step in place, for the parameters that have a gradient.

        Args: gradients shaped as the parameters; rates per iteration; `rows` how many rows of each parameter
        move, from the first (the sky is last, so this freezes it); `step` from 1, for the bias correction.
        """
        parameters = self.gaussians.tensors()
        for name, gradient in gradients.items():
            adam_(
                parameters[name],
                gradient,
                self.exp_avg[name],
                self.exp_avg_sq[name],
                lr=rates[name],
                step=step,
                rows=rows[name],
            )

    def rearrange(self, source: Tensor, fresh: Tensor, sky: int) -> None:
        """Row i becomes a copy of row source[i]; where `fresh` its moments are zero.

        Args: source (M,) int64; fresh (M,) bool; sky: how many of the new rows are sky, at the end.
        """
        tensors = {name: tensor[source] for name, tensor in self.gaussians.tensors().items()}
        self.gaussians = Gaussians(**tensors, sky=sky)
        for moments in (self.exp_avg, self.exp_avg_sq):
            for name, moment in moments.items():
                moments[name] = moment[source]
                moments[name][fresh] = 0

    def drop_broken(self) -> int:
        """Remove Gaussians with a parameter that is not finite or a zero quaternion; returns how many."""
        tensors = self.gaussians.tensors()
        sound = torch.ones(len(self.gaussians), dtype=torch.bool, device=self.gaussians.means.device)
        for tensor in tensors.values():
            sound &= torch.isfinite(tensor).flatten(1).all(1) if tensor.dim() > 1 else torch.isfinite(tensor)
        sound &= (self.gaussians.quats != 0).any(1)
        broken = len(sound) - int(sound.sum())
        if broken:
            sky = int(sound[len(sound) - self.gaussians.sky :].sum())
            source = sound.nonzero()[:, 0]
            self.rearrange(source, torch.zeros_like(source, dtype=torch.bool), sky)
        return broken


def finite(loss: Tensor, gradients: Mapping[str, Tensor]) -> float:
    """The loss as a number, and the assurance that it and its gradients are finite.

    Raises: FloatingPointError with the name of what is not.
    """
    # a sum is not finite if a term is not: one cheap pass over the gradients, one wait for the device
    sums = torch.stack([loss.detach(), *(gradient.sum() for gradient in gradients.values())]).tolist()
    if not all(map(math.isfinite, sums)):
        for name, tensor in {"loss": loss, **{f"gradient of {n}": g for n, g in gradients.items()}}.items():
            if not bool(torch.isfinite(tensor).all()):
                raise FloatingPointError(name)
    return float(sums[0])
