"""How fast a task goes and how well: the source of its `Progress` events."""

import math
import time
from dataclasses import dataclass, field

import psutil
import torch

from panolog.workers.events import Progress

INTERVAL = 1.0  # seconds between two reports


@dataclass
class Meter:
    """Means since the last report."""

    task: str
    iterations: int
    device: str
    _since: float = field(default_factory=time.monotonic)
    _losses: list[float] = field(default_factory=list)
    _psnrs: list[float] = field(default_factory=list)

    def count(self, loss: float, mse: float) -> None:
        """One iteration is done, with this loss and this mean squared error of colours in [0, 1]."""
        self._losses.append(loss)
        self._psnrs.append(-10 * math.log10(max(mse, 1e-10)))

    def due(self) -> bool:
        """Whether it is time for a report."""
        return time.monotonic() - self._since >= INTERVAL

    def progress(self, iteration: int, gaussians: int, rates: dict[str, float]) -> Progress:
        """The report, and a new beginning."""
        now = time.monotonic()
        count = len(self._losses)
        report = Progress(
            self.task,
            iteration,
            self.iterations,
            rate=count / max(now - self._since, 1e-9),
            loss=sum(self._losses) / count,
            psnr=sum(self._psnrs) / count,
            gaussians=gaussians,
            memory=_memory(self.device),
            rates=rates,
        )
        self._since, self._losses, self._psnrs = now, [], []
        return report


def _memory(device: str) -> int:
    """Bytes in use: the peak of the device on CUDA, the resident size of the process on the CPU."""
    if torch.device(device).type == "cuda":
        return int(torch.cuda.max_memory_allocated(device))
    return int(psutil.Process().memory_info().rss)
