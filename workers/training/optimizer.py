"""The state of a model in training: its parameters with their Adam moments, row by row."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import torch
from torch import Tensor

from panolog.renderer.adam import Moving
from panolog.scene.errors import RunError
from panolog.scene.gaussians import EXACT, PARAMETERS, SH_REST, Gaussians
from panolog.workers.training.config import TrainConfig

MOMENT = "exp_avg."  # in `ModelState.tensors`, before the name of a parameter
AVERAGE = "average."  # before the names of what `Average.tensors` has
_COUNT = f"{AVERAGE}count"
_SMALLEST = 0.7  # of the most: least scale of the sky
UNITS = "units."  # before the names of parameters whose rate has units


@dataclass(eq=False)
class ModelState:
    """N Gaussians and the first and second moments of each parameter, all without autograd history."""

    gaussians: Gaussians
    exp_avg: dict[str, Tensor]  # shaped as the parameters
    exp_avg_sq: dict[str, Tensor]
    units: dict[str, Tensor] = field(default_factory=dict)  # (N,) of the rates of some parameters, by name

    @staticmethod
    def start(gaussians: Gaussians) -> "ModelState":
        """The state before the first step: a copy of the parameters, with zero moments."""
        tensors = {name: tensor.detach().clone() for name, tensor in gaussians.tensors().items()}
        first, second = ({name: torch.zeros_like(it) for name, it in tensors.items()} for _ in range(2))
        return ModelState(gaussians.with_tensors(tensors), first, second)

    @staticmethod
    def from_tensors(tensors: Mapping[str, Tensor]) -> "ModelState":
        """The inverse of `tensors`, sharing memory: steps change the tensors in place."""
        names = [name.removeprefix(MOMENT) for name in tensors if name.startswith(MOMENT)]
        return ModelState(
            gaussians_of(tensors),
            {name: tensors[f"{MOMENT}{name}"] for name in names},
            {name: tensors[f"exp_avg_sq.{name}"] for name in names},
            {
                name.removeprefix(UNITS): it if it.dim() == 1 else it[:, 0].contiguous()  # in older ones
                for name, it in tensors.items()
                if name.startswith(UNITS)
            },
        )

    def tensors(self) -> dict[str, Tensor]:
        """Parameters, moments and the number of sky Gaussians by name, sharing memory."""
        moments = {f"{MOMENT}{name}": tensor for name, tensor in self.exp_avg.items()}
        moments |= {f"exp_avg_sq.{name}": tensor for name, tensor in self.exp_avg_sq.items()}
        moments["sky"] = torch.tensor(self.gaussians.sky)
        if self.gaussians.exact:
            moments[EXACT] = torch.tensor(1)
        moments |= {f"{UNITS}{name}": tensor for name, tensor in self.units.items()}
        return {**self.gaussians.tensors(), **moments}

    def moving(self, rates: Mapping[str, float], rows: Mapping[str, int]) -> dict[str, Moving]:
        """What a step of Adam moves: the parameters in `rows`, by name.

        Args: rates per iteration; `rows` how many rows of each parameter move, from the first (the sky is
        last, so this freezes it).
        """
        return {
            name: Moving(
                parameter,
                self.exp_avg[name],
                self.exp_avg_sq[name],
                parameter[: rows[name]].numel(),
                rates[name],
                self.units.get(name),
            )
            for name, parameter in self.gaussians.tensors().items()
            if name in rows
        }

    def bound(self, least: float, most: float, sky: float) -> None:
        """No axis of a Gaussian is smaller or larger, in parts of its first distance from a camera.

        What is thinner than a pixel of all training panoramas is not determined by them. Seen from nearer, or
        in a picture with more pixels, it is a needle (cf. the 3D smoothing of Mip-Splatting, Yu et al. 2024).
        What is larger than its distance lies over the whole sky of a panorama: it shifts the colours of all
        that is behind, and they change when it is removed.

        Args: least and most of the scene, 0 = no bound; sky, most of the sky, 0 = no bounds. Sky of smaller
            Gaussians has gaps where a picture has more pixels.
        """
        scene = self.gaussians.scene
        if least > 0 or most > 0:
            self._bound(scene, least, most)
        if sky > 0:
            self._bound(slice(scene.stop, None), _SMALLEST * sky, sky)

    def _bound(self, rows: slice, least: float, most: float) -> None:
        distance, scales = self.units["means"][rows, None], self.gaussians.scales[rows]
        low, high = ((distance * part).log_() if part > 0 else None for part in (least, most))
        torch.clamp(scales, low, high, out=scales)

    def rearrange(self, source: Tensor, new: Tensor, sky: int) -> None:
        """Row i becomes a copy of row source[i], with zero moments if it is `new`.

        Args: source (M,) int64; new (M,) bool; sky, the number of rows at the end that are sky.
        """
        tensors = {name: tensor[source] for name, tensor in self.gaussians.tensors().items()}
        self.gaussians = self.gaussians.with_tensors(tensors, sky)
        for moments in (self.exp_avg, self.exp_avg_sq):
            for name, moment in moments.items():
                moments[name] = moment[source]
                moments[name][new] = 0
        self.units = {name: tensor[source] for name, tensor in self.units.items()}

    def drop_invalid(self) -> int:
        """Remove Gaussians with a parameter that is not finite or a zero quaternion; returns how many."""
        valid = drawable(self.gaussians)
        invalid = len(valid) - int(valid.sum())
        if invalid:
            sky = int(valid[len(valid) - self.gaussians.sky :].sum())
            source = valid.nonzero()[:, 0]
            self.rearrange(source, torch.zeros_like(source, dtype=torch.bool), sky)
        return invalid


def drawable(gaussians: Gaussians) -> Tensor:
    """(N,) bool, the Gaussians whose parameters are finite and whose quaternion is not zero."""
    valid = (gaussians.quats != 0).any(1)
    for tensor in gaussians.tensors().values():
        valid &= torch.isfinite(tensor).flatten(1).all(1) if tensor.dim() > 1 else torch.isfinite(tensor)
    return valid


def gaussians_of(tensors: Mapping[str, Tensor]) -> Gaussians:
    """The model in a checkpoint, sharing memory; coefficients that a snapshot lacks are zero."""
    model = {name: tensors[name] for name in PARAMETERS}
    if missing := SH_REST - model["shN"].shape[1]:
        model["shN"] = torch.nn.functional.pad(model["shN"], (0, 0, 0, missing))
    return Gaussians(**model, sky=int(tensors["sky"]), exact=EXACT in tensors)


def check_kind(tensors: Mapping[str, Tensor], config: TrainConfig) -> None:
    """Raises RunError if a checkpoint is of a training with another projection or unit of rates."""
    saved = EXACT in tensors, f"{UNITS}means" in tensors
    if saved != (config.projection == "exact", config.optimizer.unit == "distance"):
        projection, unit = "exact" if saved[0] else "affine", "distance" if saved[1] else "extent"
        raise RunError(
            f"the checkpoint is of a training with projection={projection} and optimizer.unit={unit}:"
            " continue it with the settings that it had"
        )


def trained_rows(gaussians: Gaussians, degree: int, *, refine: bool, sharp: bool) -> dict[str, int]:
    """How many rows of each parameter train: of the sky in Stage I its appearance, in Stage II nothing.

    Args: degree of spherical harmonics in use; refine, Stage II; sharp, whether the sky's scales train too.
    """
    scene = gaussians.scene.stop
    count = scene if refine else len(gaussians)
    used = [name for name in gaussians.tensors() if degree > 0 or name != "shN"]
    return dict.fromkeys(used, count) | {"means": scene, "scales": count if sharp else scene}


class Average:
    """The mean of a model over iterations, in the host's memory (Polyak and Juditsky 1992).

    Each view pulls the model its own way: the mean of the states between is nearer to what fits all of them
    than any one, as if rates had decayed (Izmailov et al. 2018).
    """

    def __init__(self) -> None:
        self._count = 0
        self._sums: dict[str, Tensor] = {}

    def add(self, gaussians: Gaussians) -> None:
        """Counts a model with the same rows as those before."""
        self._count += 1
        for name, tensor in gaussians.tensors().items():
            if name not in self._sums:
                # Positions may be large numbers with small differences.
                exact = torch.float64 if name == "means" else torch.float32
                self._sums[name] = torch.zeros(tensor.shape, dtype=exact)
            self._sums[name].add_(tensor.cpu())

    def take(self, gaussians: Gaussians) -> Gaussians:
        """The mean, which is no longer here then; without any, the model itself.

        Args: gaussians, the latest model, for device and kind.
        """
        if not self._count:
            return gaussians
        means = {name: (total / self._count).float() for name, total in self._sums.items()}
        self.clear()
        return gaussians.with_tensors(means).to(gaussians.means.device)

    def clear(self) -> None:
        """No model counts: rows have changed."""
        self._count, self._sums = 0, {}

    def tensors(self) -> dict[str, Tensor]:
        """For a checkpoint, by name; none if no model counts."""
        sums = {f"{AVERAGE}{name}": total for name, total in self._sums.items()}
        return sums | {_COUNT: torch.tensor(self._count)} if sums else {}

    @staticmethod
    def from_tensors(tensors: Mapping[str, Tensor]) -> "Average":
        """The inverse of `tensors`, also among others; a copy, on the CPU."""
        average = Average()
        sums = {name: tensor for name, tensor in tensors.items() if name.startswith(AVERAGE)}
        if sums:
            average._count = int(sums.pop(_COUNT))
        average._sums = {name.removeprefix(AVERAGE): tensor.clone() for name, tensor in sums.items()}
        return average
