"""What would make the host wait for a card is counted."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from unittest import mock

import numpy as np
import pytest
import torch

from tests.renderer.cuda.waits import counted

WAITS: dict[str, Callable[[torch.Tensor], object]] = {
    "item": lambda tensor: tensor[0].item(),
    "truth": lambda tensor: bool(tensor.any()),
    "number": lambda tensor: float(tensor[0]),
    "list": lambda tensor: tensor.tolist(),
    "to the CPU": lambda tensor: tensor.cpu(),
    "rows by mask": lambda tensor: tensor[tensor > 1],
    "nonzero": lambda tensor: tensor.nonzero(),
    "repeated": lambda tensor: torch.repeat_interleave(tensor.long()),
    "comparison": lambda tensor: torch.equal(tensor, tensor),
    "blocking copy": lambda tensor: torch.empty(3).copy_(tensor),
    "to a device": lambda tensor: tensor.to("cpu"),
    "to a device, by name": lambda tensor: tensor.to(dtype=torch.float64, device=torch.device("cpu")),
    "to where another is": lambda tensor: tensor.to(torch.empty(1)),
    "made on a device": lambda tensor: torch.tensor([1.0], device="cpu"),
    "of an array": lambda tensor: torch.as_tensor(np.zeros(3), device=tensor.device),
    "synchronize": lambda tensor: torch.cuda.synchronize(),
    "synchronize a stream": lambda tensor: torch.cuda.Stream.synchronize(mock.Mock()),
    "wait for an event": lambda tensor: torch.cuda.Event.synchronize(mock.Mock()),
}


@pytest.mark.parametrize("name", WAITS)
def test_waits_are_counted(name: str) -> None:
    tensor, into = torch.arange(3.0), torch.empty(3)
    with counted() as found:
        into.copy_(tensor * 2 + tensor.sum(), non_blocking=True)
        into[1:] = 5
        into[torch.tensor([0, 1])].double().sort()
        into.to(torch.float64).to("cpu", non_blocking=True)
        torch.zeros(3, device="cpu")
        torch.repeat_interleave(torch.tensor([2, 1]), output_size=3)
        with ThreadPoolExecutor(1) as other:
            other.submit(into.to, "cpu").result()
        assert not found
        WAITS[name](tensor)
    assert found.total() == 1
