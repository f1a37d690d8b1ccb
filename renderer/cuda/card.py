"""The ops on a card: kernels loaded on first use and launched on torch's current stream.

Imported when an op first runs on a GPU: a machine without one does not need cuda-core.
"""

import functools
from typing import Any

import numpy as np
import torch
from cuda.bindings import driver
from cuda.core import Device, Kernel, LaunchConfig, ObjectCode, Stream, launch
from torch import Tensor

from panolog.renderer.cuda import launches, nvrtc
from panolog.renderer.cuda.launches import Argument
from panolog.scene.errors import DeviceError

MIN_CAPABILITY = (7, 5)  # the oldest compute capability of NVRTC 13
DEFAULT_STREAM = 1  # CU_STREAM_LEGACY: torch writes its default stream as 0

stream_of = functools.lru_cache(maxsize=64)(Stream.from_handle)  # by handle; it owns nothing


def run(op: str, *arguments: Any) -> Any:
    """Run one of `ops` on the device of its first tensor."""
    first = arguments[0][0] if isinstance(arguments[0], list) else arguments[0]
    with torch.cuda.device(first.device):
        card = Card.of(first.device.index)
        card.device.set_current()  # a thread of autograd may have no context yet
        return getattr(launches, op)(card.launch, *arguments)


class Card:
    """One GPU with the kernels compiled for it."""

    def __init__(self, index: int) -> None:
        """Raises DeviceError if the card or its driver is too old, or if NVRTC is missing."""
        self.device = Device(index)
        self.torch_device = torch.device("cuda", index)
        self.arch = architecture(torch.cuda.get_device_name(index), torch.cuda.get_device_capability(index))
        check_driver()
        self.modules: dict[str, ObjectCode] = {}
        self.kernels: dict[str, Kernel] = {}

    @staticmethod
    @functools.cache
    def of(index: int) -> "Card":
        """The card of that index, always the same object."""
        return Card(index)

    def launch(
        self, kernel: str, grid: tuple[int, int], block: int, /, **arguments: launches.Argument
    ) -> None:
        """As `launches.Launch`: asynchronous, on torch's current stream.

        Raises ValueError if a tensor is elsewhere.
        """
        if 0 in grid:
            return
        for tensor in arguments.values():
            if isinstance(tensor, Tensor) and tensor.device != self.torch_device:
                raise ValueError(f"{kernel} runs on {self.torch_device}, a tensor is on {tensor.device}")
        stream = stream_of(torch.cuda.current_stream(self.torch_device).cuda_stream or DEFAULT_STREAM)
        source = nvrtc.CSRC / "cuda" / f"{_module(kernel)}.cu"
        ordered = nvrtc.in_order(source, kernel, arguments)
        launch(stream, LaunchConfig(grid=grid, block=block), self._kernel(kernel), *map(raw, ordered))

    def _kernel(self, name: str) -> Kernel:
        if name not in self.kernels:
            module = _module(name)
            if module not in self.modules:
                self.modules[module] = ObjectCode.from_cubin(nvrtc.cubin(module, self.arch), name=module)
            self.kernels[name] = self.modules[module].get_kernel(name)
        return self.kernels[name]


def _module(kernel: str) -> str:
    """The file in csrc/cuda that has a kernel: its name begins with that of the file."""
    return kernel.split("_", maxsplit=1)[0]


def architecture(name: str, capability: tuple[int, int]) -> str:
    """NVRTC's name for the architecture of a card. Raises DeviceError if it is too old."""
    if capability < MIN_CAPABILITY:
        found, needed = (".".join(map(str, version)) for version in (capability, MIN_CAPABILITY))
        raise DeviceError(f"{name} has compute capability {found}, {needed} is needed: use --device cpu")
    return f"sm_{capability[0]}{capability[1]}"


def check(index: int) -> None:
    """Raises DeviceError if this card, its driver or NVRTC is not supported: called before work begins."""
    name, capability = torch.cuda.get_device_name(index), torch.cuda.get_device_capability(index)
    check_driver()
    arch = architecture(name, capability)
    if arch not in nvrtc.nvrtc_version()[2]:
        raise DeviceError(f"NVRTC does not know {name} ({arch}): pip install -U nvidia-cuda-nvrtc")


def check_driver() -> None:
    """Raises DeviceError if the driver is too old for NVRTC: an earlier major version of CUDA."""
    _, version = driver.cuDriverGetVersion()
    major, minor, _ = nvrtc.nvrtc_version()
    if version // 1000 < major:
        of = f"{version // 1000}.{version % 1000 // 10}"
        raise DeviceError(
            f"the NVIDIA driver is of CUDA {of}, NVRTC {major}.{minor} is too new for it: update the driver, "
            f"or pip install 'cuda-bindings<{major}' nvidia-cuda-nvrtc-cu12"
        )


def raw(argument: Argument) -> Any:
    """An argument as cuda-core passes it on: pointers, integers as 64 bits, floats as 32, structs whole."""
    if isinstance(argument, bytes):
        return np.frombuffer(argument, f"V{len(argument)}")[0]
    if isinstance(argument, Tensor):
        return argument.data_ptr()
    if isinstance(argument, float):
        return np.float32(argument)
    return argument or 0
