"""What an error in a worker means, and what a task has of its GPU."""

from collections.abc import Iterator
from dataclasses import dataclass, field
from multiprocessing import Pipe, get_context
from multiprocessing.synchronize import Barrier
from typing import Any
from unittest import mock

import pytest
import torch

from panolog.orchestrator.engine.driver.local_pool import _work
from panolog.orchestrator.engine.scheduling.pool import Ended, Failed, Hello, Message, on_its_card
from panolog.orchestrator.runs.machines.nodes import Placement
from panolog.orchestrator.runs.records import Failure
from panolog.scene.errors import DeviceError, InputError, RunError
from panolog.workers.device_memory import CONTEXT
from panolog.workers.events import Event, Notice
from panolog.workers.tasks import TaskId
from tests.orchestrator.scripted import Scripted, Short

GIB = 2**30
CUDNN = "cuDNN error: CUDNN_STATUS_"
DEBUG = "\nCUDA kernel errors might be asynchronously reported at some other API call"
SHORTAGES = [
    MemoryError(),
    MemoryError("Unable to allocate 1.00 TiB for an array"),  # NumPy's
    torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 2.00 GiB"),
    torch.AcceleratorError("CUDA error: out of memory" + DEBUG),
    RuntimeError("CUDA error: out of memory" + DEBUG),  # torch before 2.8
    RuntimeError("CUDA driver error: out of memory"),  # segments that grow
    RuntimeError("CUDA error: CUBLAS_STATUS_ALLOC_FAILED when calling `cublasCreate(handle)`"),
    RuntimeError("cusolver error: CUSOLVER_STATUS_ALLOC_FAILED, when calling `cusolverDnCreate(handle)`"),
    RuntimeError(CUDNN + "ALLOC_FAILED"),
    RuntimeError(CUDNN + "INTERNAL_ERROR_DEVICE_ALLOCATION_FAILED"),
    RuntimeError(CUDNN + "INTERNAL_ERROR_HOST_ALLOCATION_FAILED"),
    RunError("loading adam failed on the GPU: CUDA_ERROR_OUT_OF_MEMORY"),  # ours, of the driver
    RuntimeError("CUDA_ERROR_OUT_OF_MEMORY: The API call failed because it was unable to allocate"),
    RuntimeError("cudaErrorMemoryAllocation: The API call failed because it was unable to allocate"),
    RuntimeError("NVRTC_ERROR_OUT_OF_MEMORY"),
    RuntimeError("[enforce fail at alloc_cpu.cpp:124] . DefaultCPUAllocator: can't allocate memory"),
    RuntimeError("unable to mmap 64 bytes from file </dev/shm/a>: Cannot allocate memory (12)"),
    RuntimeError("std::bad_alloc"),
    OSError(12, "Cannot allocate memory"),
    RuntimeError("OpenCV(5.0.0) alloc.cpp:73: error: (-4:Insufficient memory) Failed to allocate"),
]


@pytest.mark.parametrize("error", SHORTAGES, ids=lambda error: f"{type(error).__name__} {error}"[:70])
def test_every_wording_of_a_shortage_of_memory_is_one(error: BaseException) -> None:
    failed = Failed.of(error, "its traceback")
    assert (failed.kind, failed.detail) == (Failure.MEMORY, "its traceback")
    assert failed.reason.startswith("out of memory: ") and "\n" not in failed.reason


@pytest.mark.parametrize(
    ("error", "kind"),
    [
        (torch.AcceleratorError("CUDA error: an illegal memory access was encountered"), Failure.ERROR),
        (RuntimeError("CUDA error: CUBLAS_STATUS_EXECUTION_FAILED"), Failure.ERROR),
        (RunError("loading adam failed on the GPU: CUDA_ERROR_INVALID_IMAGE"), Failure.ERROR),
        (DeviceError("--device cuda: there is no GPU that torch can use"), Failure.INPUT),
        (InputError("out of memory.jpg: the image is truncated; copy it again"), Failure.INPUT),
    ],
)
def test_no_other_error_is(error: BaseException, kind: Failure) -> None:
    assert Failed.of(error, "").kind == kind


@dataclass
class Card:
    """A GPU of 24 GiB of which torch shows this much, with its context, to a process."""

    free: int
    total: int = 24 * GIB
    fractions: list[float] = field(default_factory=list)

    def patched(self) -> Any:
        """A context in which torch has this card."""
        functions: dict[str, Any] = {
            "mem_get_info": lambda: (self.free, self.total),
            "set_per_process_memory_fraction": self.fractions.append,
        }
        return mock.patch.multiple(torch.cuda, **functions)


@pytest.mark.parametrize(
    ("free", "memory", "gpus", "fractions", "taken"),
    [
        (23 * GIB, 23 * GIB, 1.0, [], 0),  # all of it, which the context has a part of
        (13 * GIB, 23 * GIB, 1.0, [], 10 * GIB - CONTEXT),
        (20 * GIB, 12 * GIB, 0.5, [(12 * GIB - CONTEXT) / (24 * GIB)], 0),
        (4 * GIB, 12 * GIB, 0.5, [(12 * GIB - CONTEXT) / (24 * GIB)], 8 * GIB - CONTEXT),
        (4 * GIB, CONTEXT // 2, 0.25, [0.0], 0),
        (4 * GIB, 0, 0.25, [], 0),  # nothing is known of it
    ],
)
def test_a_task_has_its_part_of_a_card_and_what_is_free_when_it_starts(
    free: int, memory: int, gpus: float, fractions: list[float], taken: int
) -> None:
    card, where = Card(free), Placement("a", 1.0, memory, gpus=gpus, gpu=0)
    with card.patched():
        spec = on_its_card(Short(device="cuda"), where)
    assert (card.fractions, spec.taken) == (fractions, taken)


def test_a_task_on_the_cpu_asks_no_card() -> None:
    with mock.patch("torch.cuda.mem_get_info", side_effect=AssertionError):
        spec = Short()
        assert on_its_card(spec, Placement("a", 1.0, 2**30)) is spec


class SimulatedCard:
    """A card for several processes, with the memory of torch and of the driver in each."""

    def __init__(self, turns: Barrier, used: Any) -> None:
        self.turns, self.used = turns, used
        self.own, self.limit, self.total = 0, 24 * GIB, 24 * GIB

    def info(self) -> tuple[int, int]:
        return self.total - self.used.value, self.total

    def limit_to(self, fraction: float) -> None:
        self.limit = int(fraction * self.total)

    def take(self, size: int) -> None:
        """Raises as torch where the process has no more, and as its driver where the card has none."""
        if self.own + size > self.limit:
            raise torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 1 GiB. 11.5 GiB allowed")
        with self.used.get_lock():
            if self.used.value + size > self.total:
                raise RuntimeError("CUDA driver error: out of memory")
            self.used.value += size
        self.own += size


here: SimulatedCard  # that of this process


@dataclass(frozen=True, eq=False, kw_only=True)
class Takes(Scripted):
    """Takes memory of its card in two turns."""

    sizes: tuple[int, int]  # GiB
    device: str = "cuda"

    def run(self) -> Iterator[Event]:
        for size in self.sizes:
            here.turns.wait(60)
            try:
                for _ in range(size):
                    here.take(GIB)
            finally:
                here.turns.wait(60)  # all have taken theirs, and hold it
            yield Notice(self.task, f"has {here.own // GIB} GiB")


def process(pipe: Any, turns: Barrier, used: Any) -> None:
    """A worker on half of the card."""
    global here  # noqa: PLW0603  # as the card of a process is
    here = SimulatedCard(turns, used)
    functions: dict[str, Any] = {"mem_get_info": here.info, "set_per_process_memory_fraction": here.limit_to}
    with mock.patch.multiple(torch.cuda, **functions):
        _work(Placement("a", 1.0, 12 * GIB, gpus=0.5), pipe, {})


@pytest.mark.system
def test_of_two_processes_on_a_card_the_one_that_takes_too_much_runs_out_of_memory() -> None:
    context = get_context("spawn")
    turns, used = context.Barrier(2), context.Value("q", 0)
    last: list[Message] = []
    workers = []
    for number, sizes in enumerate([(5, 5), (5, 14)]):
        ours, theirs = Pipe()
        worker = context.Process(target=process, args=(theirs, turns, used))
        worker.start()
        theirs.close()
        workers.append((worker, ours, Takes(task=TaskId.block(number), sizes=sizes)))
    for _, pipe, spec in workers:
        assert isinstance(pipe.recv(), Hello)
        pipe.send(spec)
    for worker, pipe, _ in workers:
        while not isinstance(message := pipe.recv(), Ended | Failed):
            pass
        last.append(message)
        worker.join(60)
        pipe.close()
    assert last[0] == Ended()
    assert isinstance(last[1], Failed)
    assert (last[1].kind, used.value) == (Failure.MEMORY, (10 + 11) * GIB)
