"""Processes to measure: fresh ones for a function, and their peak memory."""

from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import ParamSpec, TypeVar

P = ParamSpec("P")
T = TypeVar("T")


def in_fresh_process(work: Callable[P, T], *args: P.args, **kwargs: P.kwargs) -> T:
    """The result of a module-level function in a new interpreter, which shares no memory with this one.

    Raises what the function raises.
    """
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as executor:
        return executor.submit(work, *args, **kwargs).result()


def peak_memory() -> int:
    """Largest resident set so far of this process, in bytes (`VmHWM`, so Linux only).

    `getrusage` would count the parent's memory too.
    """
    status = Path("/proc/self/status").read_text()
    return int(status.partition("VmHWM:")[2].split()[0]) * 1024
