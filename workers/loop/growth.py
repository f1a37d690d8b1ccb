"""Growth strategies for training loops of one's own: those of `panolog.train`, on torch's optimizers."""

from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor

from panolog.partition.bounds import baseline
from panolog.renderer.rasterize import Raster
from panolog.scene.gaussians import PARAMETERS, Gaussians
from panolog.workers.training.config import TrainConfig
from panolog.workers.training.densify import Statistics
from panolog.workers.training.initialise import extent_of
from panolog.workers.training.optimizer import ModelState
from panolog.workers.training.relocate import Growth, Place
from panolog.workers.training.schedule import Schedule

_MOMENTS = ("exp_avg", "exp_avg_sq")  # of Adam, by row


class _Strategy:
    """When Gaussians are added and removed, and which."""

    method: ClassVar[str]

    def __init__(
        self,
        centers: ArrayLike,
        iterations: int,
        *,
        sky: int = 0,
        seed: int = 0,
        reset: Mapping[str, Any] | None = None,
        **densify: Any,
    ) -> None:
        places = np.asarray(centers, np.float64)
        settings = {"densify": {**densify, "method": self.method}, "reset": reset or {}}
        config = TrainConfig.model_validate(settings)
        if config.densify.split_gradient > 0:
            raise ValueError(
                "split_gradient is of absolute gradients, which a raster does not have: set it to 0"
            )
        extent = extent_of(places, baseline(places))
        self._schedule = Schedule(config, iterations, extent, refine=False)
        self._sky, self._seed = sky, seed
        self._growth: Growth | None = None
        self._statistics: Statistics

    @property
    def extent(self) -> float:
        """The extent of 3DGS in world units, a factor of rates of means: 1.1 radii of the cameras."""
        return self._schedule.extent

    @torch.no_grad()
    def step(
        self, parameters: dict[str, Tensor], optimizer: torch.optim.Optimizer, raster: Raster, iteration: int
    ) -> None:
        """Call this after each step of the optimizer, before the next `zero_grad`.

        Where rows change, `parameters` and the optimizer get new tensors, with the moments of theirs.

        Args:
            parameters: leaves by name: means, quats, scales, opacities, sh0 (N, 1, 3) and shN (N, 15, 3), the
                sky last.
            optimizer: has the parameters; Adam or one like it.
            raster: what the loss of this iteration was of, after `backward`.
            iteration: from 1 to `iterations`.

        Raises:
            ValueError: a parameter is missing, nothing went backward through the raster, or rows change while
                the optimizer has more by row than Adam's two moments, as with `amsgrad`.
        """
        if raster.screen.grad is None:
            raise ValueError("the raster has no gradient: call backward, then this")
        if missing := [name for name in PARAMETERS if name not in parameters]:
            raise ValueError(f"parameters has no {', '.join(missing)}: it needs {', '.join(PARAMETERS)}")
        schedule = self._schedule
        if self._growth is None:
            count, pixels = len(parameters["means"]) - self._sky, raster.alpha[0].numel()
            self._growth = Growth(schedule, Place(None, count, pixels), self._seed, "coarse")
            self._statistics = Statistics.zeros(count, raster.alpha.device, schedule.config.densify)
        if schedule.collects(iteration):
            seen = zip(raster.screen.grad, raster.visible, raster.cameras, strict=True)
            for gradient, visible, camera in seen:
                self._statistics.add(gradient, visible, parameters["means"], camera)
        if schedule.changes(iteration):
            state = _state_of(parameters, optimizer, self._sky)
            self._statistics, _ = self._growth.after(state, self._statistics, iteration)
            self._sky = state.gaussians.sky  # without what was not finite
            _write(state, parameters, optimizer)


class Clone3DGS(_Strategy):
    """Adaptive density control of 3DGS: clone small and split large Gaussians with large gradients, prune.

    Args:
        centers: (K, 3) the positions of the cameras, world units.
        iterations: the length of the training; what the settings state for 30,000 iterations scales with it.
        sky: how many Gaussians at the end are a sky, which takes no part.
        seed: of the positions of split Gaussians.
        reset: settings of `reset`, the opacity reset, such as {"every": 3000}.
        densify: settings of `densify`, as `panolog run --set densify.gradient=2e-4` has them: `gradient`,
            `percent_dense`, `start`, `until`, `every`, `max_gaussians` and so on.

    Raises:
        ValueError: a setting is not known or out of range.

    >>> import panolog
    >>> scene = panolog.read_scene(SCENE)
    >>> growth = panolog.Clone3DGS(scene.centers, iterations=500, gradient=1e-4)
    """

    method = "clone-split"


class Relocate(_Strategy):
    """Growth to a budget: transparent Gaussians move to live ones, and opacities are not reset (3DGS-MCMC).

    Args:
        centers, iterations, sky, seed, reset: as those of `Clone3DGS`.
        densify: settings of `densify`: `growth`, `weight`, `filled`, `max_gaussians` and so on.

    Raises:
        ValueError: a setting is not known or out of range.

    >>> import panolog
    >>> scene = panolog.read_scene(SCENE)
    >>> growth = panolog.Relocate(scene.centers, iterations=500, growth=0.75, weight="gradient")
    """

    method = "relocate"


def _state_of(parameters: Mapping[str, Tensor], optimizer: torch.optim.Optimizer, sky: int) -> ModelState:
    """The parameters and their moments, sharing memory; zeros before the first step."""
    leaves = {name: parameters[name] for name in PARAMETERS}
    for name, leaf in leaves.items():
        for kind, value in optimizer.state[leaf].items():
            if kind not in _MOMENTS and isinstance(value, Tensor) and value.shape == leaf.shape:
                known = " and ".join(_MOMENTS)
                raise ValueError(f"the optimizer has {kind} of {name}: rows take only {known} with them")
    first, second = (
        {name: optimizer.state[leaf].get(moment, torch.zeros_like(leaf)) for name, leaf in leaves.items()}
        for moment in _MOMENTS
    )
    own: dict[str, Any] = {name: leaf.detach() for name, leaf in leaves.items()}
    return ModelState(Gaussians(**own, sky=sky), first, second)


def _write(state: ModelState, parameters: dict[str, Tensor], optimizer: torch.optim.Optimizer) -> None:
    """The inverse of `_state_of`: new leaves take the places of those that have other rows now."""
    for name, tensor in state.gaussians.tensors().items():
        before = parameters[name]
        own = optimizer.state.pop(before, {})
        for moment, values in zip(_MOMENTS, (state.exp_avg, state.exp_avg_sq), strict=True):
            if moment in own:
                own[moment] = values[name]
        parameters[name] = tensor.detach().requires_grad_(before.requires_grad)
        optimizer.state[parameters[name]] = own
        for group in optimizer.param_groups:
            group["params"] = [parameters[name] if it is before else it for it in group["params"]]
