"""The peak memory of one case, in this process; `benchmarks.memory` runs it in a fresh one.

    python -m benchmarks.memory_probe '{"device": "cpu", "threads": 2, "recipe": {"width": 1024, "count": 9}}'

On the CPU it is the growth of the resident set (VmHWM after /proc/self/clear_refs, so Linux). The C library
is told through its environment to give freed blocks back at once, or blocks freed before would hide some of
it.
"""

import json
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import torch

from benchmarks.cases import Recipe, random_case
from benchmarks.iteration import Trainer

ENVIRONMENT = {"MALLOC_MMAP_THRESHOLD_": "65536", "MALLOC_TRIM_THRESHOLD_": "0"}
_SELF = Path("/proc/self")


@dataclass(frozen=True)
class Peaks:
    """Bytes above those of model, moments and target, which are there before and after."""

    rasterization: int  # one forward and one backward pass, the gradients of all parameters included
    iteration: int  # with loss and Adam


def peaks(recipe: Recipe, device: str, threads: int) -> Peaks:
    """Of the recipe's first image."""
    torch.set_num_threads(threads)
    tiny = random_case(200, 64).to(device)
    Trainer(tiny, tiny.shots[0]).iteration()  # what is loaded once is none of the case's
    case = recipe.make().to(device)
    trainer = Trainer(case, case.shots[0])
    rise = _rise_cuda if device == "cuda" else _rise_cpu
    return Peaks(rise(trainer.rasterize), rise(trainer.iteration))


def _rise_cuda(work: Callable[[], None]) -> int:
    torch.cuda.synchronize()
    torch.cuda.reset_peak_memory_stats()
    before = torch.cuda.memory_allocated()
    work()
    torch.cuda.synchronize()
    return torch.cuda.max_memory_allocated() - before


def _rise_cpu(work: Callable[[], None]) -> int:
    (_SELF / "clear_refs").write_text("5")  # the peak is what is there now
    before = _status("VmHWM")
    work()
    return _status("VmHWM") - before


def _status(key: str) -> int:
    """Bytes, from a line such as `VmHWM:  13552 kB`."""
    lines = (_SELF / "status").read_text().splitlines()
    (line,) = (line for line in lines if line.startswith(f"{key}:"))
    return int(line.split()[1]) * 1024


def main() -> None:
    """The process: one JSON object in, one out."""
    asked = json.loads(sys.argv[1])
    found = peaks(Recipe(**asked["recipe"]), asked["device"], asked["threads"])
    print(json.dumps(vars(found)))


if __name__ == "__main__":
    main()
