"""CPU tensors that behave as those on a GPU in one respect: numpy gets only copies of them on the CPU."""

from typing import Any

from torch import Tensor

from panolog.scene.images import Staged, Upload, View


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


class ToDevice(Upload):
    """Moves views to that device."""

    def stage(self, view: View) -> Staged:
        return Staged(view_on_device(view))
