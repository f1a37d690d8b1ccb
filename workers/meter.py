"""How fast a task goes and how well: the source of its `Progress` events."""

import math
import resource
import time
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

import psutil
import torch

from panolog.workers.events import Progress
from panolog.workers.tasks import TaskId

INTERVAL = 1.0  # seconds between two reports
_CLEAR_REFS, _RESET_PEAK = Path("/proc/self/clear_refs"), "5"  # proc(5): the peak becomes the present size


@dataclass
class Meter:
    """Means since the last report, and peaks since it was made: one for each task."""

    task: TaskId
    iterations: int
    device: str
    _since: float = field(default_factory=time.monotonic)
    _losses: list[float] = field(default_factory=list)
    _psnrs: list[float] = field(default_factory=list)

    def __post_init__(self) -> None:
        forget_peaks(self.device)

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
            memory=memory_in_use(self.device),
            host_peak=host_peak(),
            rates=rates,
        )
        self._since, self._losses, self._psnrs = now, [], []
        return report


def forget_peaks(device: str) -> None:
    """Peaks are counted anew from here: a worker's process may have had other tasks before this one."""
    if torch.device(device).type == "cuda":
        torch.cuda.reset_peak_memory_stats(device)
    with suppress(OSError):  # where the kernel forbids it, the peak is that of the process's life
        _CLEAR_REFS.write_text(_RESET_PEAK)


def host_peak() -> int:
    """Bytes: the most that this process has had resident since `forget_peaks`."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024  # Linux counts in KiB


def memory_in_use(device: str) -> int:
    """Bytes in use: the peak on CUDA since `forget_peaks`, the resident size of the process on the CPU."""
    if torch.device(device).type == "cuda":
        return int(torch.cuda.max_memory_allocated(device))
    return int(psutil.Process().memory_info().rss)
