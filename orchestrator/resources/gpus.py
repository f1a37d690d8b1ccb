"""The GPUs of this machine, as nvidia-smi lists them: CUDA is not started on them."""

import os
import shutil
import subprocess

from panolog.orchestrator.resources.nodes import Gpu

_QUERY = ("--query-gpu=index,uuid,name,memory.free", "--format=csv,noheader,nounits")
_TIMEOUT_S = 30.0  # a machine without persistence mode wakes its GPUs first


def describe_gpus(count: int) -> tuple[Gpu, ...]:
    """The `count` GPUs that Ray has found here, with their free memory.

    Where nvidia-smi lists others too, and nothing selects ours, all are taken for the least of them; where it
    is missing, nothing is known of them.
    """
    gpus = _visible(_listed()) if count else []
    if not gpus:
        return (Gpu(),) * count
    if len(gpus) == count:
        return tuple(gpus)
    least = min(gpus, key=lambda gpu: gpu.memory)
    return (Gpu(least.name, least.memory),) * count


def _listed() -> list[tuple[str, Gpu]]:
    """All GPUs by their index."""
    program = shutil.which("nvidia-smi")
    if program is None:
        return []
    try:
        output = subprocess.run(
            [program, *_QUERY], capture_output=True, text=True, timeout=_TIMEOUT_S, check=True
        ).stdout
    except (OSError, subprocess.SubprocessError):
        return []
    return _parse(output)


def _parse(output: str) -> list[tuple[str, Gpu]]:
    """What `nvidia-smi` prints: a line "0, GPU-5a…, NVIDIA GeForce RTX 4090, 24111" (MiB) for each GPU."""
    rows = [[cell.strip() for cell in line.split(",")] for line in output.splitlines()]
    return [
        (row[0], Gpu(row[2], int(row[3]) * 2**20, row[1]))
        for row in rows
        if len(row) == 4 and row[3].isdecimal()
    ]


def _visible(listed: list[tuple[str, Gpu]]) -> list[Gpu]:
    """Those that CUDA_VISIBLE_DEVICES names, by index or by (the beginning of) their UUID, in its order."""
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
