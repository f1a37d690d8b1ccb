"""The CUDA kernels on the host: every access checked, threads in an order of chance."""

import contextlib
import ctypes
import re
from collections.abc import Collection
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

from panolog.renderer.cuda.nvrtc import CSRC, MODULES, in_order, module_of
from panolog.renderer.cuda.parts import Argument
from tests.renderer.cuda.emulation.build import library, line_of

EMPTY = {"empty", "new_empty", "empty_like", "empty_strided", "new_empty_strided"}  # of torch's operations


class KernelError(AssertionError):
    """What a launch did wrong."""


class _Range(ctypes.Structure):
    _fields_ = (("begin", ctypes.c_void_p), ("end", ctypes.c_void_p))


class _Tensor(ctypes.Structure):
    _fields_ = (
        ("name", ctypes.c_char_p),
        ("data", ctypes.c_void_p),
        ("bytes", ctypes.c_int64),
        ("unit", ctypes.c_int64),
        ("written", ctypes.c_void_p),
    )


class _Launch(ctypes.Structure):
    """`Launch` of emulation.h."""

    _fields_ = (
        ("enter", ctypes.c_void_p),
        ("values", ctypes.c_void_p),
        ("kinds", ctypes.c_char_p),
        ("grid", ctypes.c_void_p),
        ("threads", ctypes.c_uint),
        ("seed", ctypes.c_uint64),
        ("flush", ctypes.c_bool),
        ("tensors", _Range),
        ("taken", _Range),
        ("image", _Range),
        ("shared", _Range),
        ("variables", _Range),
    )


class EmulatedLaunch:
    """A `Launch` whose device is the host. Raises KernelError where a card might do anything."""

    def __init__(
        self,
        folder: Path = CSRC / "cuda",
        *,
        seed: int = 0,
        contract: bool = False,
        flush: bool = False,
        into: Path | None = None,
        kernels: Collection[str] | None = None,
        instrument: bool = True,
    ) -> None:
        """`contract` and `flush` round as a card may: with fused multiply-adds, with denormals as zero.

        Args:
            folder: of the .cu files.
            seed: of the order of blocks and threads.
            contract: in the modules that NVRTC compiles so.
            flush: in the modules that NVRTC compiles with fast arithmetic.
            into: where libraries are built, whatever the compiler warns of; without it once for all tests.
            kernels: which of `folder` run, the others being those of csrc/cuda; without it all.
            instrument: those of `folder` have no checks of their accesses yet.
        """
        self.folder = folder
        self.seed = seed
        self.contract = contract
        self.flush = flush
        self.into = into
        self.kernels = kernels
        self.instrument = instrument
        self.memory = _Memory()

    def __call__(self, kernel: str, grid: tuple[int, int], block: int, /, **arguments: Argument) -> None:
        module = module_of(kernel)
        own = self.kernels is None or kernel in self.kernels
        source = (self.folder if own else CSRC / "cuda") / f"{module}.cu"
        rounding = MODULES.get(module, {})
        contract = self.contract and rounding.get("fma", True)
        code = library(source, contract, self.into if own else None, self.instrument or not own)
        run = getattr(code, f"run_{kernel}")
        run.argtypes, run.restype = (_Launch,), ctypes.c_char_p
        kinds, values = zip(*map(_raw, in_order(source, kernel, arguments)), strict=True)
        pointers = (ctypes.c_void_p * len(values))(*(ctypes.addressof(value) for value in values))
        size, tensors = (ctypes.c_uint * 2)(*grid), self._tensors(arguments)
        launch = _Launch(
            values=ctypes.addressof(pointers),
            kinds="".join(kinds).encode(),
            grid=ctypes.addressof(size),
            threads=block,
            seed=self.seed,
            flush=self.flush and rounding.get("use_fast_math", False),
            tensors=_Range(ctypes.addressof(tensors), ctypes.addressof(tensors) + ctypes.sizeof(tensors)),
        )
        error = run(launch)
        if error is not None:
            lines = re.sub(r"\+0x([0-9a-f]+)", lambda at: line_of(code._name, int(at[1], 16)), error.decode())
            raise KernelError(f"{kernel}: {lines}, seed {self.seed}")
        self.seed += 1

    def watching(self) -> contextlib.AbstractContextManager[Any]:
        """Within it, `new_empty` and its like make tensors without values: NaN, which no kernel may read."""
        return self.memory

    def _tensors(self, arguments: dict[str, Argument]) -> "ctypes.Array[_Tensor]":
        given: dict[int, tuple[str, Tensor]] = {}
        for name, argument in arguments.items():
            pointed = {name: argument} if isinstance(argument, Tensor) else getattr(argument, "tensors", {})
            given |= {
                tensor.data_ptr(): (inner, tensor) for inner, tensor in pointed.items() if tensor.numel()
            }
        return (_Tensor * len(given))(
            *(
                _Tensor(name.encode(), at, it.nbytes, it.itemsize, self.memory.written(it))
                for at, (name, it) in given.items()
            )
        )


class _Memory(TorchDispatchMode):  # type: ignore[no-untyped-call]
    """Which bytes of tensors that are made empty have been written since."""

    def __init__(self) -> None:
        super().__init__()  # type: ignore[no-untyped-call]
        self.empty: dict[int, tuple[Tensor, Tensor]] = {}  # by address: bytes, and whether each is written

    def __exit__(self, *error: Any) -> None:
        super().__exit__(*error)  # type: ignore[no-untyped-call]
        self.empty.clear()

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        result = func(*args, **(kwargs or {}))
        if func.overloadpacket.__name__ in EMPTY and result.numel():
            raw = result.untyped_storage()
            data = torch.tensor([], dtype=torch.uint8).set_(raw)
            data.fill_(0xFF)
            self.empty[raw.data_ptr()] = (data, torch.zeros_like(data))
        named = dict(zip((given.name for given in func._schema.arguments), args, strict=False)) | (
            kwargs or {}
        )
        for given in func._schema.arguments:
            argument = named.get(given.name)
            if given.alias_info is not None and given.alias_info.is_write and isinstance(argument, Tensor):
                self.empty.pop(argument.untyped_storage().data_ptr(), None)
        return result

    def written(self, tensor: Tensor) -> int | None:
        """Where the marks of a tensor's bytes are."""
        storage = tensor.untyped_storage().data_ptr()
        if storage not in self.empty:
            return None
        return self.empty[storage][1].data_ptr() + tensor.data_ptr() - storage


def _raw(
    argument: Argument,
) -> tuple[str, ctypes.c_void_p | ctypes.c_float | ctypes.c_int64 | ctypes.Array[ctypes.c_char]]:
    """Kind and value as the kernel takes it: pointers, integers as 64 bits, floats as 32, structs whole."""
    if isinstance(argument, bytes):
        return f"b{len(argument)}", ctypes.create_string_buffer(argument, len(argument))
    if isinstance(argument, Tensor):
        assert argument.is_contiguous()
        return "p", ctypes.c_void_p(argument.data_ptr())
    if isinstance(argument, float):
        return "f", ctypes.c_float(argument)
    return ("p", ctypes.c_void_p(None)) if argument is None else ("i", ctypes.c_int64(argument))


def has_fused_multiply_add() -> bool:
    """Whether this processor has the instructions of `contract`."""
    info = Path("/proc/cpuinfo")
    return info.exists() and " fma " in info.read_text()
