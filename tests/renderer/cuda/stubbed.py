"""The CUDA path without a card: the ops on CPU tensors, by the sequences of `renderer.cuda.launches`."""

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from typing import Any
from unittest import mock

import torch

from panolog.renderer import ops
from panolog.renderer.cuda import launches
from panolog.renderer.cuda.parts import Argument, Launch

_ZEROS = ("tile_counts", "report", "gradient", "partials")
OPS = ("rasterize", "rasterize_backward", "bake", "photometric", "absolute_difference")


def no_launch(kernel: str, grid: tuple[int, int], block: int, /, **arguments: Argument) -> None:
    """A `Launch` that runs nothing: outputs hold what their memory held before."""


def without_pairs(kernel: str, grid: tuple[int, int], block: int, /, **arguments: Argument) -> None:
    """A `Launch` that runs nothing, for which no Gaussian meets a tile: gradients are 0, nothing is wrong."""
    for name, tensor in arguments.items():
        if isinstance(tensor, torch.Tensor) and (name in _ZEROS or name.startswith("out_")):
            tensor.zero_()


def _run(launch: Launch, op: str, *arguments: Any) -> Any:
    """Runs an op as `renderer.cuda.card.run` does, with this `launch` in place of a card's."""
    return getattr(launches, op)(launch, **ops.named(op, arguments))


@contextmanager
def stubbed(launch: Launch) -> Iterator[None]:
    """Within it, ops and trainers on the CPU run as they do on a card, their kernels by `launch`."""
    library: Any = torch.library.Library("panolog", "IMPL")  # type: ignore[no-untyped-call]
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # what is overridden
            for name in OPS:
                library.impl(name, partial(_run, launch, name), "CPU", allow_override=True)
        with mock.patch.object(ops, "launcher", return_value=launch):
            yield
    finally:
        library._destroy()
