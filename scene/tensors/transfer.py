"""Tensors as one block of memory, and on their way to a GPU: the host waits for none of them."""

import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

_ALIGNMENT = 16  # bytes between beginnings of tensors, a multiple of every element


def packed_bytes(tensors: Mapping[str, Tensor]) -> int:
    """Bytes of memory that holds these tensors one after the other."""
    return sum(_padded(tensor.nbytes) for tensor in tensors.values())


def pack(tensors: Mapping[str, Tensor], memory: Tensor) -> None:
    """Copies tensors one after the other into `memory` (bytes,) uint8."""
    for name, part in unpack(memory, tensors).items():
        part.copy_(tensors[name])


def unpack(memory: Tensor, tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Parts of `memory` (bytes,) uint8 with the shapes and types of the tensors, one after the other."""
    parts, at = {}, 0
    for name, tensor in tensors.items():
        parts[name] = memory[at : at + tensor.nbytes].view(tensor.dtype).view(tensor.shape)
        at += _padded(tensor.nbytes)
    return parts


def _padded(size: int) -> int:
    return -(-size // _ALIGNMENT) * _ALIGNMENT


def sleeping_event() -> torch.cuda.Event:
    """An event on a GPU for which a thread of the host sleeps; by default it would keep a core busy."""
    return torch.cuda.Event(blocking=True)  # type: ignore[no-untyped-call]


@dataclass(frozen=True, eq=False)
class Moving:
    """Tensors on their way to a device."""

    tensors: dict[str, Tensor]  # they are there, and have their values once `ready` has occurred
    memory: Tensor | None = None  # (bytes,) uint8 on a GPU that they are parts of
    ready: torch.cuda.Event | None = None


class Mover:
    """How tensors get to the device: on the CPU they are there."""

    def begin(self, layout: Mapping[str, Tensor], fill: Callable[[Tensor], None]) -> Moving:
        """Begins to move tensors; called by any thread.

        Args: layout, their shapes and types; fill, writes what `pack` would into memory (bytes,) uint8.
        """
        memory = torch.empty(packed_bytes(layout), dtype=torch.uint8)
        fill(memory)
        return Moving(unpack(memory, layout))

    def end(self, moving: Moving) -> dict[str, Tensor]:
        """The tensors, for what is computed next; called by the thread that computes."""
        return moving.tensors

    @staticmethod
    def to(device: torch.device) -> "Mover":
        """The mover that a device requires."""
        return CudaMover(device) if device.type == "cuda" else Mover()


class CudaMover(Mover):
    """Through pinned memory and a stream of its own.

    Each thread that begins has one pinned buffer, as large as the most that it has moved at once.
    """

    def __init__(self, device: torch.device) -> None:
        """Args: device, a GPU."""
        self._device = device
        self._stream = torch.cuda.Stream(device)  # type: ignore[no-untyped-call]
        self._own = threading.local()

    def begin(self, layout: Mapping[str, Tensor], fill: Callable[[Tensor], None]) -> Moving:
        """Begins to move as `Mover.begin`, and returns while the copy runs."""
        pinned = self._buffer(packed_bytes(layout))
        fill(pinned)
        with torch.cuda.stream(self._stream):  # which the memory then belongs to, see `end`
            memory = torch.empty(len(pinned), dtype=torch.uint8, device=self._device)
            memory.copy_(pinned, non_blocking=True)
            ready = self._own.ready = sleeping_event()
            ready.record(self._stream)
        return Moving(unpack(memory, layout), memory, ready)

    def end(self, moving: Moving) -> dict[str, Tensor]:
        """Ends as `Mover.end`: the current stream waits for the copy, the host does not."""
        current = torch.cuda.current_stream(self._device)
        if moving.memory is not None and moving.ready is not None:
            current.wait_event(moving.ready)
            # Once freed, the memory may be given to the next copy: not before this stream has read it.
            moving.memory.record_stream(current)
        return moving.tensors

    def _buffer(self, size: int) -> Tensor:
        """A buffer of pinned bytes of this thread, which the copy before has left."""
        own = self._own
        if (ready := getattr(own, "ready", None)) is not None:
            ready.synchronize()
        if getattr(own, "buffer", None) is None or len(own.buffer) < size:
            own.buffer = torch.empty(size, dtype=torch.uint8, pin_memory=True)
        buffer: Tensor = own.buffer[:size]
        return buffer
