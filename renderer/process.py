"""Settings of a process that renders: its device, threads and memory."""

import gc
import logging

import torch

from panolog.renderer import _core, ops
from panolog.scene.errors import DeviceError

_LOG = logging.getLogger(__name__)


def choose_device(wanted: str | None) -> str:
    """ "cpu" or "cuda" for "auto" (None), "cpu" or "cuda": "auto" is CUDA where torch has a GPU.

    Raises DeviceError if the name is unknown, there is no GPU, or something that its kernels need is missing.
    """
    if wanted not in (None, "auto", "cpu", "cuda"):
        raise DeviceError(f"--device {wanted}: must be auto, cpu or cuda")
    if wanted == "cpu" or not torch.cuda.is_available():
        if wanted == "cuda":
            raise DeviceError("--device cuda: there is no GPU that torch can use; see `panolog doctor`")
        return "cpu"
    from panolog.renderer.cuda import nvrtc  # noqa: PLC0415  # only where there is a GPU

    nvrtc.nvrtc_version()  # names the missing package; importing card could not
    from panolog.renderer.cuda import card  # noqa: PLC0415

    card.check(torch.cuda.current_device())
    return "cuda"


def prepare(threads: int) -> None:
    """Set the number of threads of the kernels, and keep freed memory for the next iteration.

    Torch gets one thread: its operations are small here, its threads end each one with a barrier, which waits
    for a time slice of the system where another process is busy, and its idle threads occupy the cores.

    Otherwise the C library returns large blocks to the system and allocates them again, cleared page by page,
    in every iteration. Changes malloc of the whole process: for dedicated processes such as workers. Called
    before each task, it returns the memory that the previous one left.
    """
    ops.use_threads(threads)
    torch.set_num_threads(1)
    gc.collect()
    _core.keep_memory()
    _LOG.info("CPU kernels: %s, %d threads", _core.instruction_set(), threads)
