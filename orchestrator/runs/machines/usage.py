"""What the machine of a task does: its CPU, memory, disk and GPUs, measured next to the task."""

import os
import shutil
import socket
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from threading import Event as Flag
from threading import Thread
from typing import TypeVar

import psutil

from panolog.orchestrator.runs.machines.gpus import GpuUsage, measure_gpus
from panolog.orchestrator.runs.machines.machine import memory_usage

_FIRST_S, INTERVAL_S = 2.0, 10.0  # seconds until the first measurement, and between two
T = TypeVar("T")


@dataclass(frozen=True)
class Usage:
    """A measurement of one machine; sizes in bytes."""

    node: str  # host name
    cpu: float  # 0 to 1, mean over the cores that the task may use
    memory_used: int
    memory_total: int
    disk_used: int  # of the disk of temporary files
    disk_total: int
    gpus: tuple[GpuUsage, ...] = ()


def with_usage(events: Iterable[T], first: float = _FIRST_S) -> Iterator[T | Usage]:
    """The events of a task, and before one of them every ten seconds a measurement of its machine.

    Args: first, seconds until the first one. A thread measures: nvidia-smi can take a second.
    """
    latest, end = list[Usage](), Flag()

    def measure_often() -> None:
        psutil.cpu_percent(percpu=True)  # starts its interval
        wait = first
        while not end.wait(wait):
            with suppress(OSError):
                latest[:] = [measure()]
            wait = INTERVAL_S

    Thread(target=measure_often, daemon=True).start()
    try:
        for event in events:
            if latest:
                yield latest.pop()
            yield event
    finally:
        end.set()


def measure() -> Usage:
    """Measures this machine now, its CPU since the last call. Raises OSError if the kernel does not say."""
    cores, (used, total) = psutil.cpu_percent(percpu=True), memory_usage()
    mine = [cores[core] for core in os.sched_getaffinity(0) if core < len(cores)]
    disk = shutil.disk_usage(tempfile.gettempdir())
    return Usage(
        node=socket.gethostname(),
        cpu=sum(mine) / (100 * max(1, len(mine))),
        memory_used=used,
        memory_total=total,
        disk_used=disk.used,
        disk_total=disk.total,
        gpus=measure_gpus(),
    )
