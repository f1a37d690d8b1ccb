"""Settings of a process that renders again and again."""

import torch

from panolog.renderer import _core


def prepare(threads: int) -> None:
    """Give torch and the kernels this many threads, and keep freed memory for the next iteration.

    Without the latter the C library returns large blocks to the system and takes them again, cleared page by
    page, in every iteration. For a process of its own, such as a worker: it changes malloc for all of it.
    """
    torch.set_num_threads(threads)
    _core.keep_memory()
