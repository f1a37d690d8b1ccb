"""A torch whose GPU is the CPU, for transfers and checkpoints: it says in which order things happen."""

import threading
from types import SimpleNamespace
from typing import Any

import torch
from torch import Tensor


class Memory:
    """A tensor that says which of its operations matter for the order between streams."""

    def __init__(self, tensor: Tensor, log: list[str]) -> None:
        self.tensor, self.log = tensor, log

    def __len__(self) -> int:
        return len(self.tensor)

    def __getitem__(self, at: slice) -> Any:
        return self.tensor[at]

    def copy_(self, source: Tensor, *, non_blocking: bool) -> None:
        assert non_blocking
        self.log.append("copy")
        self.tensor.copy_(source)

    def record_stream(self, stream: str) -> None:
        self.log.append(f"memory used by {stream}")


class Torch:
    """A torch with the parts of CUDA that `CudaMover` and `Staging` use; everything else is torch's own."""

    def __init__(self) -> None:
        self.log: list[str] = []
        self.pinned: list[int] = []  # sizes of the pinned buffers, 0 where unused ones are given back
        self.cuda = SimpleNamespace(
            Stream=lambda _: "uploads",
            Event=self._event,
            stream=self._switched,
            current_stream=lambda *_: SimpleNamespace(
                wait_event=lambda _: self.log.append("training waits"),
                synchronize=lambda: self.log.append("the host waits"),
                __str__=lambda: "training",
            ),
        )
        self.accelerator = SimpleNamespace(empty_host_cache=lambda: self.pinned.append(0))

    def __getattr__(self, name: str) -> Any:
        return getattr(torch, name)

    def empty(self, size: int, *, pin_memory: bool = False, device: Any = "cpu", **options: Any) -> Any:
        if pin_memory:
            self.pinned.append(size)
        made = torch.empty(size, **options)
        return Memory(made, self.log) if str(device) == "cuda" else made

    def _event(self, *, blocking: bool) -> SimpleNamespace:
        assert blocking  # who waits sleeps
        return SimpleNamespace(
            record=lambda stream: self.log.append(f"event on {stream}"),
            synchronize=lambda: self.log.append(f"{threading.current_thread().name} waits"),
        )

    def _switched(self, stream: str) -> Any:
        self.log.append(f"stream {stream}")
        return torch.no_grad()  # some context
