"""Checkpoints on disk: one safetensors file, complete or absent.

The driver, whose memory is small, makes PLYs of the models in them, in pieces.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file

from panolog.scene.errors import InputError, RunError
from panolog.scene.files import Locate, atomic, here
from panolog.scene.gaussians import Gaussians
from panolog.workers.events import Checkpoint
from panolog.workers.tasks import TaskId
from panolog.workers.training.optimizer import AVERAGE, EXACT, MOMENT

_ROWS = 2**16  # of a model in memory at a time


@dataclass(frozen=True)
class CheckpointFile:
    """The checkpoint in a file."""

    path: Path
    locate: Locate = here  # where the file is on this machine

    def load(self) -> Checkpoint:
        """`load`."""
        return load(self.locate(self.path))


def save(path: Path, checkpoint: Checkpoint) -> None:
    """Write a checkpoint by atomic rename: its tensors as they are, task and iteration as metadata.

    Raises:
        RunError: the file cannot be written, with the system's reason.
    """
    metadata = {"task": str(checkpoint.task), "iteration": str(checkpoint.iteration)}
    try:
        with atomic(path) as temporary:
            save_file(checkpoint.tensors, temporary, metadata)
    except (OSError, SafetensorError) as error:
        raise RunError(f"cannot write the checkpoint {path}: {error}; is the disk full?") from error


def load(path: Path) -> Checkpoint:
    """Read a checkpoint that `save` wrote; its tensors are on the CPU.

    Raises:
        RunError: the file is missing, truncated or no checkpoint.
    """
    return _read(path, tensors=True)


def iteration_of(path: Path) -> int:
    """The iteration of a checkpoint that `save` wrote, from its header. Raises RunError as `load` does."""
    return name_of(path)[1]


def name_of(path: Path) -> tuple[TaskId, int]:
    """The task and the iteration of a checkpoint, from its header. Raises RunError as `load` does."""
    found = _read(path, tensors=False)
    return found.task, found.iteration


def _read(path: Path, *, tensors: bool) -> Checkpoint:
    try:
        with safe_open(path, framework="pt") as file:
            metadata = file.metadata() or {}
            names = file.keys() if tensors else ()
            content = {name: file.get_tensor(name) for name in names}
        return Checkpoint(TaskId.parse(metadata["task"]), int(metadata["iteration"]), content)
    except (OSError, SafetensorError, KeyError, ValueError, InputError) as error:
        raise RunError(
            f"{path} is not a whole checkpoint ({error}); remove it, and the task starts from the beginning"
        ) from error


class SavedModel:
    """The Gaussians of a checkpoint: their mean over the last iterations, if that has begun."""

    def __init__(self, path: Path) -> None:
        """Reads the header. Raises RunError if the file is no whole checkpoint."""
        self._path = path
        try:
            with safe_open(path, framework="pt") as file:
                names = set(file.keys())
                self.names = sorted(name.removeprefix(MOMENT) for name in names if name.startswith(MOMENT))
                self.count: int = file.get_slice("means").get_shape()[0]
                self.sky = int(file.get_tensor("sky"))
                self.averaged = int(file.get_tensor(f"{AVERAGE}count")) if f"{AVERAGE}count" in names else 0
                self.exact = EXACT in names
        except (OSError, SafetensorError, KeyError) as error:
            raise RunError(f"{path} is not a whole checkpoint ({error})") from error

    def pieces(self, rows: int = _ROWS) -> Iterator[Gaussians]:
        """All of them in order, sky last, at most `rows` at a time."""
        with safe_open(self._path, framework="pt") as file:
            kind = AVERAGE if self.averaged else ""
            slices = {name: file.get_slice(f"{kind}{name}") for name in self.names}
            for start in range(0, self.count, rows):
                stop = min(start + rows, self.count)
                tensors = {name: part[start:stop] for name, part in slices.items()}
                if self.averaged:
                    tensors = {name: (part / self.averaged).float() for name, part in tensors.items()}
                sky = max(0, stop - max(start, self.count - self.sky))
                piece = Gaussians(**tensors, sky=sky, exact=self.exact)
                yield piece.select(_finite(piece) | (torch.arange(len(piece)) >= piece.scene.stop))


def _finite(piece: Gaussians) -> torch.Tensor:
    """(N,) which can be drawn: the others would have been removed at the next densification."""
    valid = (piece.quats != 0).any(1)
    for tensor in piece.tensors().values():
        valid &= torch.isfinite(tensor).flatten(1).all(1) if tensor.dim() > 1 else torch.isfinite(tensor)
    return valid
