"""Peak memory of one case, measured in a fresh process.

On the CPU it is the growth of the resident set. The C library must return freed blocks to the system at once:
otherwise blocks that were freed before would hide a part of the growth.
"""

import ctypes
import functools

from benchmarks.processes import in_fresh_process
from benchmarks.rasterizer.cases import CaseSpec, street_case
from benchmarks.rasterizer.iteration import TrainingStep
from panolog.renderer import ops
from panolog.workers.meter import host_peak, memory_in_use, reset_peaks

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
    reset_peaks(device)
    before = memory_in_use(device)
    step.iteration()
    return (memory_in_use(device) if device == "cuda" else host_peak()) - before
