"""Settings of a process that renders again and again."""

import gc

import torch

from panolog.renderer import _core
from panolog.scene.errors import DeviceError


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
    from panolog.renderer import cuda_compile  # noqa: PLC0415  # only where there is a GPU

    cuda_compile.nvrtc_version()  # says what is missing, before cuda_device cannot be imported
    from panolog.renderer import cuda_device  # noqa: PLC0415

    cuda_device.check(torch.cuda.current_device())
    return "cuda"


def prepare(threads: int) -> None:
    """Give torch and the kernels this many threads, and keep freed memory for the next iteration.

    Without the latter the C library returns large blocks to the system and takes them again, cleared page by
    page, in every iteration. For a process of its own, such as a worker: it changes malloc for all of it.
    Called before each task, it gives back what the one before has left.
    """
    torch.set_num_threads(threads)
    gc.collect()
    _core.keep_memory()
