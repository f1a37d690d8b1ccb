"""How tensors go through Ray: as arrays, whose bytes pass from a process's memory into the object store.

Left to itself torch pickles the bytes of each tensor, and Ray that pickle: with a checkpoint of a million
Gaussians these are one and a half gigabytes more.
"""

import warnings
from typing import Any

import torch
from numpy.typing import NDArray
from ray.util import register_serializer


def send_as_arrays() -> None:
    """In a worker, whenever it begins a task: what it yields goes this way."""
    register_serializer(torch.Tensor, serializer=_array, deserializer=_tensor)


def _array(tensor: torch.Tensor) -> NDArray[Any]:
    return tensor.detach().cpu().contiguous().numpy()


def _tensor(array: NDArray[Any]) -> torch.Tensor:
    """Shares the object store's memory: it is there to be read."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # torch warns of what cannot be written
        return torch.from_numpy(array)
