"""Counts the memory of a GPU without one: tensors on torch's device "meta" have no memory.

Ops run as on a card, by `renderer.cuda.launches`, but no kernel does.
"""

import weakref
from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from panolog.renderer.cuda import launches
from tests.renderer.cuda.stubbed import no_launch

aten = torch.ops.aten
DEVICE = "meta"
_BLOCK = 512  # bytes: torch's allocator rounds up to them


class CountedMemory(TorchDispatchMode):  # type: ignore[no-untyped-call]
    """Within it, the live bytes of all tensors of `DEVICE`: each storage counts until nothing holds it.

    What depends on values has a size that is given: `pairs` of splats and tiles, and `chosen`, the fraction
    of rows that each `nonzero` finds.
    """

    def __init__(self, pairs: int = 0, chosen: float = 0.0) -> None:
        super().__init__()  # type: ignore[no-untyped-call]
        self.pairs, self.chosen = pairs, chosen
        self.live = self.peak = 0  # bytes
        self._known: set[int] = set()

    def restart(self) -> None:
        """The peak is now what is live."""
        self.peak = self.live

    def __torch_dispatch__(
        self, func: Any, types: Any, args: tuple[Any, ...] = (), kwargs: Mapping[str, Any] | None = None
    ) -> Any:
        kwargs = kwargs or {}
        if func.namespace == "panolog":
            with self:
                return getattr(launches, func.__name__.split(".")[0])(no_launch, *args, **kwargs)
        if func in (aten.item.default, aten._local_scalar_dense.default) and args[0].is_meta:
            return 1.0 if args[0].is_floating_point() else self.pairs
        if (
            func is aten.copy_.default and not args[0].is_meta and args[1].is_meta
        ):  # the report of an iteration
            return args[0].copy_(torch.tensor([0.0, 0.0, self.pairs, 0.0]))
        if func is aten._to_copy.default and args[0].is_meta and _to_host(kwargs):
            found = aten.empty_like(args[0], device="cpu")  # memory that is not touched takes none
            return found.zero_() if found.numel() < _BLOCK else found
        if func is aten.nonzero.default and args[0].is_meta:
            found = args[0].new_empty((int(len(args[0]) * self.chosen), args[0].dim()), dtype=torch.int64)
        else:
            found = func(*args, **kwargs)
        for tensor in tree_leaves(found):
            if isinstance(tensor, Tensor) and tensor.is_meta:
                self._count(tensor.untyped_storage())
        if func is aten.sort.stable:
            self.peak = max(self.peak, self.live + _sort_buffers(args[0]))
        return found

    def _count(self, storage: torch.UntypedStorage) -> None:
        if storage._cdata in self._known:
            return
        self._known.add(storage._cdata)
        size = -(-storage.nbytes() // _BLOCK) * _BLOCK
        self.live += size
        self.peak = max(self.peak, self.live)
        weakref.finalize(storage, self._free, storage._cdata, size)

    def _free(self, storage: int, size: int) -> None:
        self._known.remove(storage)
        self.live -= size


def _to_host(kwargs: Mapping[str, Any]) -> bool:
    device = kwargs.get("device")
    return device is not None and torch.device(device).type == "cpu"


def _sort_buffers(keys: Tensor) -> int:
    """Bytes that torch.sort of one long row allocates besides its results.

    As in aten/src/ATen/native/cuda/Sort.cu: indices from 0, int64; and CUB's buffers of keys and of indices.
    """
    return len(keys) * (8 + keys.element_size() + 8)
