"""Peak memory of one case, measured in a fresh process.

On the CPU it is the growth of the resident set (VmHWM after /proc/self/clear_refs, so Linux only). The C
library must return freed blocks to the system at once: otherwise blocks that were freed before would hide
a part of the growth.
"""

import ctypes
import functools
from collections.abc import Callable
from pathlib import Path

import torch

from benchmarks.processes import in_fresh_process, peak_memory
from benchmarks.rasterizer.cases import CaseSpec, street_case
from benchmarks.rasterizer.iteration import TrainingStep
from panolog.renderer import ops

_TRIM_THRESHOLD, _MMAP_THRESHOLD = -1, -3  # M_TRIM_THRESHOLD and M_MMAP_THRESHOLD of mallopt(3)


@functools.cache
def probe(spec: CaseSpec, device: str, threads: int) -> int:
    """Bytes at the peak of an iteration above those of model, moments and target, which are there before.

    Raises InputError if model or scene cannot be read.
    """
    return in_fresh_process(peak, spec, device, threads)


def peak(spec: CaseSpec, device: str, threads: int) -> int:
    """That of the spec's first image, in this process."""
    ops.use_threads(threads)
    libc = ctypes.CDLL(None)
    libc.mallopt(_MMAP_THRESHOLD, 2**16)
    libc.mallopt(_TRIM_THRESHOLD, 0)
    tiny = street_case(200, 64).to(device)
    TrainingStep(tiny, tiny.views[0]).iteration()  # loads what is loaded once
    case = spec.make().to(device)
    step = TrainingStep(case, case.views[0])
    libc.malloc_trim(0)
    rise = _rise_cuda if device == "cuda" else _rise_cpu
    return rise(step.iteration)


def _rise_cuda(work: Callable[[], None]) -> int:
    torch.cuda.synchronize()
    torch.cuda.reset_peak_memory_stats()
    before = torch.cuda.memory_allocated()
    work()
    torch.cuda.synchronize()
    return torch.cuda.max_memory_allocated() - before


def _rise_cpu(work: Callable[[], None]) -> int:
    Path("/proc/self/clear_refs").write_text("5")  # resets the peak to the present size
    before = peak_memory()
    work()
    return peak_memory() - before
