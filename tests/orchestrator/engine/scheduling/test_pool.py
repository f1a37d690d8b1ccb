"""What an error in a worker means, and what a task has of its GPU."""

from dataclasses import dataclass, field
from typing import Any
from unittest import mock

import pytest
import torch

from panolog.orchestrator.engine.scheduling.pool import Failed, guarded, on_its_card
from panolog.orchestrator.runs.machines.nodes import Placement
from panolog.orchestrator.runs.records import Failure
from panolog.scene.errors import DeviceError, InputError, RunError
from panolog.workers.device_memory import CONTEXT
from tests.orchestrator.scripted import TASK, Fails, Short

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
        (ValueError("no"), Failure.ERROR),
        (DeviceError("--device cuda: there is no GPU that torch can use"), Failure.INPUT),
        (InputError("out of memory.jpg: the image is truncated; copy it again"), Failure.INPUT),
    ],
)
def test_no_other_error_is(error: BaseException, kind: Failure) -> None:
    failed = Failed.of(error, "its traceback")
    expected = isinstance(error, InputError | RunError)
    assert (failed.kind, failed.detail) == (kind, "" if expected else "its traceback")
    assert failed.reason == (str(error) if expected else f"{type(error).__name__}: {error}")


@pytest.mark.parametrize(("how", "raised"), [("wrong", InputError), ("read", RunError), ("device", RunError)])
def test_what_may_be_otherwise_elsewhere_is_no_wrong_input(how: str, raised: type[Exception]) -> None:
    with pytest.raises(raised):
        list(guarded(TASK, Fails(how=how).run()))


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
