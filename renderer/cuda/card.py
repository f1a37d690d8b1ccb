"""The ops on a card: kernels loaded on first use and launched on torch's current stream.

Imported when an op first runs on a GPU: a machine without one does not need cuda-core.
"""

import ctypes
import functools
import struct
import threading
from collections.abc import Mapping
from itertools import accumulate
from typing import Any

import torch
from cuda.bindings import driver
from cuda.core import Device
from torch import Tensor

from panolog.renderer.cuda import launches, nvrtc
from panolog.renderer.cuda.parts import Argument
from panolog.scene.errors import DeviceError, RunError

MIN_CAPABILITY = (7, 5)  # the oldest compute capability of NVRTC 13
DEFAULT_STREAM = 1  # CU_STREAM_LEGACY: torch writes its default stream as 0


def run(op: str, given: Mapping[str, Any]) -> Any:
    """Run one of `ops`, with its arguments by name, on the device of the first, a tensor."""
    device = next(iter(given.values())).device
    with torch.cuda.device(device):
        card = Card.of(device.index)
        card.device.set_current()  # a thread of autograd may have no context yet
        return getattr(launches, op)(card.launch, **given)


class Card:
    """One GPU with the kernels compiled for it."""

    def __init__(self, index: int) -> None:
        """Raises DeviceError if the card or its driver is too old, or if NVRTC is missing."""
        self.device = Device(index)
        self.torch_device = torch.device("cuda", index)
        self.arch = architecture(torch.cuda.get_device_name(index), torch.cuda.get_device_capability(index))
        check_driver()
        self.kernels = Kernels(self.arch)

    @staticmethod
    @functools.cache
    def of(index: int) -> "Card":
        """The card of that index, always the same object."""
        return Card(index)

    def launch(self, kernel: str, grid: tuple[int, int], block: int, /, **arguments: Argument) -> None:
        """Launches a kernel as `parts.Launch` says: asynchronous, on torch's current stream.

        Raises ValueError if a tensor is elsewhere.
        """
        if 0 in grid:
            return
        index = self.torch_device.index
        for name, argument in arguments.items():
            if isinstance(argument, Tensor) and argument.get_device() != index:
                found = f"{name} is a tensor on {argument.device}"
                raise ValueError(f"{kernel} runs on {self.torch_device}, {found}")
        stream = torch.cuda.current_stream(self.torch_device).cuda_stream or DEFAULT_STREAM
        self.kernels.launch(stream, kernel, grid, block, arguments)


class Kernels:
    """The kernels of one architecture, loaded on first use into the current context of the driver."""

    def __init__(self, arch: str) -> None:
        self.arch = arch
        self.libraries: dict[str, Any] = {}  # of the driver, by module
        self.prepared: dict[str, Prepared] = {}

    def launch(
        self,
        stream: int,
        kernel: str,
        grid: tuple[int, int],
        block: int,
        arguments: Mapping[str, Argument],
    ) -> None:
        """Launches a kernel on a stream of the driver. Raises RunError with the driver's reason."""
        prepared = self.prepared.get(kernel)
        if prepared is None:
            prepared = self.prepared[kernel] = self._prepare(kernel, arguments)
        prepared.launch(stream, grid, block, arguments)

    def _prepare(self, kernel: str, arguments: Mapping[str, Argument]) -> "Prepared":
        module = nvrtc.module_of(kernel)
        if module not in self.libraries:
            code = nvrtc.code(module, self.arch)
            loaded = driver.cuLibraryLoadData(code, [], [], 0, [], [], 0)
            self.libraries[module] = _checked(loaded, f"loading {module}")
        handle = _checked(driver.cuLibraryGetKernel(self.libraries[module], kernel.encode()), kernel)
        return Prepared.of(kernel, handle, arguments)


class Prepared:
    """A kernel with the memory from which the driver copies its arguments in each launch."""

    def __init__(self, name: str, handle: Any, arguments: Mapping[str, Argument]) -> None:
        """Args: of its first launch, in the order of its parameters."""
        self.name = name
        self.handle = driver.CUfunction(int(handle))  # the driver launches both
        self.names = tuple(arguments)
        kinds = [_kind(argument) for argument in arguments.values()]
        self.packed = struct.Struct("=" + "".join(kinds))
        self.memory = ctypes.create_string_buffer(self.packed.size)
        sizes = [struct.calcsize(f"={kind}") for kind in kinds]
        begins = accumulate(sizes[:-1], initial=ctypes.addressof(self.memory))
        self.parameters = (ctypes.c_void_p * len(kinds))(*begins)
        self.at = ctypes.addressof(self.parameters)
        self.lock = threading.Lock()  # the driver copies without the interpreter's lock

    @staticmethod
    def of(kernel: str, handle: Any, arguments: Mapping[str, Argument]) -> "Prepared":
        """Args: of its first launch, in any order. Raises TypeError if the names are not the parameters'."""
        source = nvrtc.CSRC / "cuda" / f"{nvrtc.module_of(kernel)}.cu"
        names = nvrtc.in_order(source, kernel, {name: name for name in arguments})
        return Prepared(kernel, handle, {name: arguments[name] for name in names})

    def launch(
        self, stream: int, grid: tuple[int, int], block: int, arguments: Mapping[str, Argument]
    ) -> None:
        """Raises TypeError if the names are not those of the parameters, RunError if the driver refuses."""
        if len(arguments) != len(self.names) or not all(name in arguments for name in self.names):
            names = ", ".join(self.names)
            raise TypeError(f"the kernel {self.name} takes {names}, not {', '.join(arguments)}")
        values = [raw(arguments[name]) for name in self.names]
        with self.lock:
            self.packed.pack_into(self.memory, 0, *values)
            done = driver.cuLaunchKernel(self.handle, *grid, 1, block, 1, 1, 0, stream, self.at, 0)
        _checked(done, self.name)


def _kind(argument: Argument) -> str:
    """How struct packs what `raw` returns: 8 bytes or a multiple."""
    match argument:
        case bytes():
            return f"{len(argument)}s{-len(argument) % 8}x"
        case float():
            return "f4x"
        case int():
            return "q"
        case _:
            return "Q"


def raw(argument: Argument) -> int | float | bytes:
    """An argument as a number: tensors and None as pointers."""
    if isinstance(argument, Tensor):
        return argument.data_ptr()
    return 0 if argument is None else argument


def _checked(result: Any, what: str) -> Any:
    """The value of a call of the driver. Raises RunError with its reason where it failed."""
    error, *values = result
    if error != driver.CUresult.CUDA_SUCCESS:
        raise RunError(f"{what} failed on the GPU: {error.name}")
    return values[0] if values else None


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
    nvrtc.target(architecture(name, capability))


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
