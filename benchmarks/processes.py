"""Processes to measure: fresh ones for a function, their peak memory, files out of the page cache."""

import os
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import ParamSpec, TypeVar

P = ParamSpec("P")
T = TypeVar("T")


def fresh_process() -> ProcessPoolExecutor:
    """Executor whose process starts a new interpreter, so that it shares no memory with this one."""
    return ProcessPoolExecutor(1, mp_context=get_context("spawn"))


def in_fresh_process(work: Callable[P, T], *args: P.args, **kwargs: P.kwargs) -> T:
    """The result of a module-level function that runs in a new interpreter. Raises what it raises."""
    with fresh_process() as executor:
        return executor.submit(work, *args, **kwargs).result()


def peak_memory() -> int:
    """Largest resident set so far of this process, in bytes (`VmHWM`, so Linux only).

    `getrusage` would count the parent's memory too.
    """
    status = Path("/proc/self/status").read_text()
    return int(status.partition("VmHWM:")[2].split()[0]) * 1024


def resident_memory() -> int:
    """Resident set of this process at present, in bytes."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


def drop_from_page_cache(path: Path) -> None:
    """Writes a file's changes to the disk and removes the file from the page cache."""
    with path.open("rb") as file:
        os.fsync(file.fileno())
        os.posix_fadvise(file.fileno(), 0, 0, os.POSIX_FADV_DONTNEED)
