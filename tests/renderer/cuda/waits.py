"""Counts what would make the host wait for a card, on tensors of the CPU that stand for those of the card.

Not what happens inside of an op of ours: torch's dispatcher shows it as a whole.
"""

from collections import Counter
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from typing import Any
from unittest import mock

import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

_OPS = {  # their result, or its size, is read by the host
    "aten::_local_scalar_dense",
    "aten::nonzero",
    "aten::is_nonzero",
    "aten::equal",
    "aten::masked_select",
    "aten::_unique2",
    "aten::unique_dim",
    "aten::unique_consecutive",
    "aten::repeat_interleave.Tensor",
}
_METHODS = ("cpu", "tolist")  # not all of them reach the dispatcher for a CPU tensor


class _Ops(TorchDispatchMode):
    def __init__(self, found: Counter[str]) -> None:
        super().__init__()  # type: ignore[no-untyped-call]
        self.found = found

    def __torch_dispatch__(
        self, func: Any, types: Any, args: Any = (), kwargs: dict[str, Any] | None = None
    ) -> Any:
        name = func._schema.name + (f".{func._schema.overload_name}" if func._schema.overload_name else "")
        blocking = name == "aten::copy_" and not (args[2] if len(args) > 2 else False)
        moves = name == "aten::_to_copy" and (kwargs or {}).get("device") is not None
        by_mask = name.startswith("aten::index") and _has_mask(args)
        if name in _OPS or blocking or by_mask or moves:
            self.found[name] += 1
        return func(*args, **(kwargs or {}))


def _has_mask(args: Any) -> bool:
    """Whether rows are chosen by bool: the host must know how many."""
    indices = args[1] if len(args) > 1 and isinstance(args[1], (list, tuple)) else ()
    return any(isinstance(each, Tensor) and each.dtype in (torch.bool, torch.uint8) for each in indices)


@contextmanager
def counted(allowed: tuple[Tensor, ...] = ()) -> Iterator[Counter[str]]:
    """What waits, by name. Args: allowed, tensors that are on the host in any case."""
    found: Counter[str] = Counter()
    own = {tensor.untyped_storage().data_ptr() for tensor in allowed}
    with ExitStack() as stack:
        for name in _METHODS:
            stack.enter_context(mock.patch.object(Tensor, name, _counting(name, found, own)))
        stack.enter_context(mock.patch("torch.cuda.synchronize", _counting("synchronize", found, own)))
        stack.enter_context(_Ops(found))
        yield found


def _counting(name: str, found: Counter[str], own: set[int]) -> Any:
    method = getattr(Tensor, name, None)

    def call(*arguments: Any, **named: Any) -> Any:
        if not (arguments and arguments[0].untyped_storage().data_ptr() in own):
            found[name] += 1
        return None if method is None else method(*arguments, **named)

    return call
