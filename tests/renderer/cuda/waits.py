"""Counts what would make the host wait for a card, on tensors of the CPU that stand for those of the card.

Not what happens inside of an op of ours: torch's dispatcher shows it as a whole.
"""

import threading
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
# Of tensors; not all of them reach the dispatcher for a CPU tensor, which is there already.
_METHODS = ("cpu", "tolist", "to", "cuda")
_MADE = ("tensor", "as_tensor", "asarray")  # by the host, and then copied to a device that is named
_SYNCHRONIZE = ("synchronize", "Stream.synchronize", "Event.synchronize")


class _Ops(TorchDispatchMode):
    def __init__(self, found: Counter[str]) -> None:
        super().__init__()  # type: ignore[no-untyped-call]
        self.found = found

    def __torch_dispatch__(
        self, func: Any, types: Any, args: Any = (), kwargs: dict[str, Any] | None = None
    ) -> Any:
        name = func._schema.name + (f".{func._schema.overload_name}" if func._schema.overload_name else "")
        blocking = name == "aten::copy_" and not (args[2] if len(args) > 2 else False)
        by_mask = name.startswith("aten::index") and _has_mask(args)
        known = (kwargs or {}).get("output_size") is not None  # of what is repeated
        if (name in _OPS and not known) or blocking or by_mask:
            self.found[name] += 1
        return func(*args, **(kwargs or {}))


def _has_mask(args: Any) -> bool:
    """Whether rows are chosen by bool: the host must know how many."""
    indices = args[1] if len(args) > 1 and isinstance(args[1], (list, tuple)) else ()
    return any(isinstance(each, Tensor) and each.dtype in (torch.bool, torch.uint8) for each in indices)


@contextmanager
def counted(allowed: tuple[Tensor, ...] = ()) -> Iterator[Counter[str]]:
    """What waits in this thread, by name. Args: allowed, tensors that are on the host in any case.

    A copy between devices counts unless it is `non_blocking`, also of a tensor that would be there.
    """
    found: Counter[str] = Counter()
    own = {_storage(tensor) for tensor in allowed}
    with ExitStack() as stack:
        for name in _METHODS:
            stack.enter_context(mock.patch.object(Tensor, name, _counting(getattr(Tensor, name), found, own)))
        for name in _MADE:
            stack.enter_context(mock.patch.object(torch, name, _counting(getattr(torch, name), found, own)))
        for name in _SYNCHRONIZE:
            stack.enter_context(mock.patch(f"torch.cuda.{name}", _counting(None, found, own)))
        stack.enter_context(_Ops(found))
        yield found


def _counting(function: Any, found: Counter[str], own: set[int]) -> Any:
    """A function that counts those of its calls that wait. Args: function, None for one that only waits."""
    name = "synchronize" if function is None else function.__name__
    thread = threading.get_ident()

    def call(*arguments: Any, **named: Any) -> Any:
        host = bool(own) and isinstance(arguments[0], Tensor) and _storage(arguments[0]) in own
        waits = (name not in {"to", *_MADE} or _to_device(arguments, named)) and not named.get("non_blocking")
        if waits and not host and threading.get_ident() == thread:
            found[name] += 1
        return None if function is None else function(*arguments, **named)

    return call


def _to_device(arguments: tuple[Any, ...], named: dict[str, Any]) -> bool:
    """Whether a call of `Tensor.to`, or one that makes a tensor, names a device or a tensor on one."""
    others = (*arguments[1:], named.get("device"), named.get("other"))
    return any(isinstance(other, (str, torch.device, Tensor)) for other in others)


def _storage(tensor: Tensor) -> int:
    return tensor.untyped_storage().data_ptr()
