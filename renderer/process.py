"""Settings of a process that renders: its device, threads and memory."""

import gc
import logging
import os
import platform
import warnings
from collections.abc import Callable, Mapping

import torch
from torch.torch_version import TorchVersion

from panolog.renderer import _core, ops
from panolog.renderer.unused_gpu import unused_gpu
from panolog.scene.errors import DeviceError

_LOG = logging.getLogger(__name__)


def choose_device(wanted: str | None, warn: Callable[[str], object] = _LOG.warning) -> str:
    """ "cpu" or "cuda" for "auto" (None), "cpu" or "cuda": "auto" is CUDA where torch has a GPU.

    Args: warn, called with one line where "auto" is the CPU although there is a GPU; by default it is logged,
    which prints it on stderr.
    Raises DeviceError if the name is unknown, there is no GPU, or something that its kernels need is missing.
    """
    if wanted not in (None, "auto", "cpu", "cuda"):
        raise DeviceError(f"--device {wanted}: must be auto, cpu or cuda")
    if wanted == "cpu":
        return "cpu"
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # torch's several lines on an old driver
        available = torch.cuda.is_available()
    if not available:
        why = unused_gpu()
        if wanted == "cuda":
            raise DeviceError(
                f"--device cuda: {why or 'there is no GPU that torch can use; see `panolog doctor`'}"
            )
        if why:
            warn(f"{why}; the CPU is used")
        return "cpu"
    ops.card_module().check(torch.cuda.current_device())
    return "cuda"


def prepare(threads: int) -> None:
    """Set the number of threads of the kernels, and keep freed memory for the next iteration.

    Called before anything is on a GPU: torch reads the settings of its allocator there only once.

    Torch gets one thread: its operations are small here, its threads end each one with a barrier, which waits
    for a time slice of the system where another process is busy, and its idle threads occupy the cores.

    Otherwise the C library returns large blocks to the system and allocates them again, cleared page by page,
    in every iteration. Changes malloc of the whole process: for dedicated processes such as workers. Called
    before each task, it returns the memory that the previous one left.
    """
    os.environ.update(growing_segments(os.environ, platform.release(), torch.__version__))
    ops.use_threads(threads)
    torch.set_num_threads(1)
    _core.keep_memory()
    release_memory()
    _LOG.info("CPU kernels: %s, %d threads", _core.instruction_set(), threads)


def release_memory() -> None:
    """Return freed memory to the system, between works whose blocks of memory differ in size."""
    gc.collect()
    _core.release_memory()


def growing_segments(given: Mapping[str, str], release: str, version: TorchVersion) -> dict[str, str]:
    """The environment in which torch's memory on a GPU is in segments that grow; what the user has set stays.

    After a densification everything is a little larger than the blocks that it had. Without this option
    torch keeps those and allocates others, until the GPU is full.

    Args: given, the environment; release, of the system; version, of torch.
    """
    current, former = "PYTORCH_ALLOC_CONF", "PYTORCH_CUDA_ALLOC_CONF"
    if current in given or former in given:
        return {}
    if "microsoft" in release.lower():  # WSL: the first allocation fails, pytorch/pytorch#192330
        return {}
    return {current if version >= "2.9" else former: "expandable_segments:True"}
