"""Speed, loss and memory of a task: its `Progress` events."""

import math
import resource
import time
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

import psutil
import torch

from panolog.workers.tasks import Progress, TaskId

INTERVAL = 1.0  # seconds between two reports
_CLEAR_REFS, _RESET_PEAK = Path("/proc/self/clear_refs"), "5"  # proc(5): sets the peak to the current size
_STATUS = Path("/proc/self/status")


@dataclass
class Meter:
    """Means since the last report, and peaks since its construction: one for each task."""

    task: TaskId
    iterations: int
    device: str
    _since: float = field(default_factory=time.monotonic)
    _count: int = 0
    _losses: list[float] = field(default_factory=list)
    _psnrs: list[float] = field(default_factory=list)

    def __post_init__(self) -> None:
        reset_peaks(self.device)

    def count(self, loss: float | None = None, mse: float | None = None) -> None:
        """One iteration is done. Optional: its loss and mean squared error of colours in [0, 1].

        A view of which a mask leaves nothing has an error of 0, and no part in the means.
        """
        self._count += 1
        if loss is not None and mse:
            self._losses.append(loss)
            self._psnrs.append(-10 * math.log10(max(mse, 1e-10)))

    def due(self) -> bool:
        """Whether it is time for a report."""
        return time.monotonic() - self._since >= INTERVAL

    def progress(self, iteration: int, gaussians: int, rates: dict[str, float] | None = None) -> Progress:
        """The report since the last one; starts the next interval."""
        now = time.monotonic()
        report = Progress(
            self.task,
            iteration,
            self.iterations,
            rate=self._count / max(now - self._since, 1e-9),
            loss=_mean(self._losses),
            psnr=_mean(self._psnrs),
            gaussians=gaussians,
            memory=memory_in_use(self.device),
            host_peak=host_peak(),
            rates=rates or {},
        )
        self._since, self._count, self._losses, self._psnrs = now, 0, [], []
        return report


def _mean(values: list[float]) -> float | None:
    return sum(values) / len(values) if values else None


def reset_peaks(device: str) -> None:
    """Restart the measurement of peaks: the process of a worker may have run other tasks before."""
    if torch.device(device).type == "cuda":
        torch.cuda.reset_peak_memory_stats(device)
    with suppress(OSError):  # if the kernel forbids it, the peak is that since the start of the process
        _CLEAR_REFS.write_text(_RESET_PEAK)


def host_peak() -> int:
    """Bytes: the most that this process has had resident since `reset_peaks`.

    Without /proc from `getrusage`, which also counts the process that started this one.
    """
    with suppress(OSError, IndexError):
        return int(_STATUS.read_text().partition("VmHWM:")[2].split()[0]) * 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024  # Linux counts in KiB


def memory_in_use(device: str) -> int:
    """Bytes in use: the peak on CUDA since `reset_peaks`, the resident size of the process on the CPU."""
    if torch.device(device).type == "cuda":
        return int(torch.cuda.max_memory_allocated(device))
    return int(psutil.Process().memory_info().rss)
