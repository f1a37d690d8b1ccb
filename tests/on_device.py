"""CPU tensors that behave as those on a GPU in one respect: numpy gets only copies of them on the CPU.

And the marks of tests that need a real one.
"""

from collections.abc import Callable, Mapping
from typing import Any, TypeVar

import pytest
import torch
from torch import Tensor

from panolog.scene.images import View
from panolog.scene.tensors.transfer import Mover, Moving

ON_A_CARD = (pytest.mark.cuda, pytest.mark.skipif(not torch.cuda.is_available(), reason="CUDA: no card"))
on_all_devices = pytest.mark.parametrize("device", ["cpu", pytest.param("cuda", marks=ON_A_CARD)])
Test = TypeVar("Test", bound=Callable[..., None])


def needs_a_card(test: Test) -> Test:
    """Marks a test that runs on a card only."""
    for mark in ON_A_CARD:
        test = mark(test)
    return test


class OnDevice(Tensor):
    """Results of operations are on the device, too. Copies to the CPU are counted in `copies`."""

    copies = 0
    is_cuda = True

    def numpy(self, *, force: bool = False) -> Any:
        raise TypeError("can't convert cuda device type tensor to numpy")

    def cpu(self, *_: Any, **__: Any) -> Tensor:
        OnDevice.copies += 1
        return self.as_subclass(Tensor).clone()

    def tolist(self) -> Any:
        OnDevice.copies += 1
        return self.as_subclass(Tensor).tolist()


def moved(tensor: Tensor) -> Tensor:
    """The same values on the device."""
    return tensor.clone().as_subclass(OnDevice)


def view_on_device(view: View) -> View:
    """The same view on the device."""
    return View.of(view.row, {name: moved(layer) for name, layer in view.layers().items()})


class ToDevice(Mover):
    """Moves tensors to that device."""

    def begin(self, layout: Mapping[str, Tensor], fill: Callable[[Tensor], None]) -> Moving:
        return Moving({name: moved(layer) for name, layer in layout.items()})
