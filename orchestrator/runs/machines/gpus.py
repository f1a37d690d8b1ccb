"""The GPUs of this machine, as nvidia-smi lists them: CUDA is not started on them."""

import os
import time
from dataclasses import dataclass

from panolog.orchestrator.runs.machines.nodes import Gpu
from panolog.renderer.nvidia_smi import nvidia_smi

_FREE = "index,uuid,name,memory.free,memory.total"
_USAGE = "name,utilization.gpu,memory.used,memory.total"
_IDLE = 0.9  # of a GPU's memory: one with more free has no worker
_SETTLE_S, _TIMES = 3.0, 10  # between two measurements of one that is in use, and how many

Rows = list[list[str]]  # cells of a table


@dataclass(frozen=True)
class GpuUsage:
    """What one GPU does; None where nvidia-smi does not know it."""

    name: str
    utilization: float | None  # 0 to 1
    memory_used: int | None  # bytes
    memory_total: int | None


def measure_gpus() -> tuple[GpuUsage, ...]:
    """All GPUs of this machine, whichever of them this process may use."""
    rows = [row for row in nvidia_smi(_USAGE) if len(row) == 4]
    return tuple(
        GpuUsage(name, None if (share := _number(load)) is None else share / 100, _mebi(used), _mebi(total))
        for name, load, used, total in rows
    )


def _mebi(text: str) -> int | None:
    count = _number(text)
    return None if count is None else count * 2**20


def _number(text: str) -> int | None:
    """A whole number; None for "[N/A]", as of a GPU that is divided."""
    return int(text) if text.isdecimal() else None


def gpus_to_share() -> tuple[str, ...]:
    """What CUDA_VISIBLE_DEVICES calls the GPUs that this process may use, in its order.

    None are known where nvidia-smi is missing, or lists them divided (MIG).
    """
    if os.environ.get("CUDA_VISIBLE_DEVICES") == "":  # a user wants none
        return ()
    return tuple(gpu.uuid for gpu in _visible(_parse(nvidia_smi(_FREE))))


def describe_gpus(count: int) -> tuple[Gpu, ...]:
    """The `count` GPUs that Ray has found here, with the memory that is free while no task runs there.

    After a kill, workers of the last driver need seconds to free theirs: a GPU in use is measured again until
    it has no more than before. Where nvidia-smi lists others too, and nothing selects ours, all are taken for
    the least of them; where it is missing, nothing is known of them.
    """
    gpus = _visible(_parse(_settled())) if count else []
    if not gpus:
        return (Gpu(),) * count
    if len(gpus) == count:
        return tuple(gpus)
    least = min(gpus, key=lambda gpu: gpu.memory)
    return (Gpu(least.name, least.memory),) * count


def _settled() -> Rows:
    """What nvidia-smi prints of all GPUs, once those in use free nothing more."""
    rows = nvidia_smi(_FREE)
    for _ in range(_TIMES):
        if not _in_use(rows):
            break
        time.sleep(_SETTLE_S)  # nothing reports that a process has freed its memory
        before, rows = rows, nvidia_smi(_FREE)
        if _free(rows) <= _free(before):
            break
    return rows


def _in_use(rows: Rows) -> bool:
    numbers = [row[3:5] for row in rows if len(row) == 5]
    return any(int(free) < _IDLE * int(total) for free, total in numbers if f"{free}{total}".isdecimal())


def _free(rows: Rows) -> int:
    return sum(gpu.memory for _, gpu in _parse(rows))


def _parse(rows: Rows) -> list[tuple[str, Gpu]]:
    """All GPUs by index, of rows "0, GPU-5a…, NVIDIA GeForce RTX 4090, 24111, 24564" (MiB)."""
    return [
        (row[0], Gpu(row[2], int(row[3]) * 2**20, row[1]))
        for row in rows
        if len(row) == 5 and row[3].isdecimal()
    ]


def _visible(listed: list[tuple[str, Gpu]]) -> list[Gpu]:
    """The GPUs that CUDA_VISIBLE_DEVICES names, by index or by (the beginning of) a UUID, in its order."""
    wanted = os.environ.get("CUDA_VISIBLE_DEVICES")
    if not wanted:  # Ray empties it for tasks that request no GPU, such as this one
        return [gpu for _, gpu in listed]
    names = [name.strip() for name in wanted.split(",")]
    return [
        gpu
        for name in names
        for index, gpu in listed
        if name == index or (name.startswith("GPU-") and gpu.uuid.startswith(name))
    ]
