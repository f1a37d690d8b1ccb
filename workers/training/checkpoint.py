"""Checkpoints on disk: one safetensors file, complete or absent.

The driver, whose memory is small, makes PLYs of the models in them, in pieces.
"""

import zlib
from collections.abc import Generator, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from panolog.scene.errors import InputError, RunError
from panolog.scene.files import Locate, atomic, here
from panolog.scene.gaussians import EXACT, Gaussians
from panolog.workers.events import Checkpoint, Notice
from panolog.workers.specs import Source
from panolog.workers.tasks import TaskId
from panolog.workers.training.optimizer import AVERAGE, MOMENT, drawable

_SUM = "crc32"  # in the metadata
_ROWS = 2**16  # of a model in memory at a time


class DamagedCheckpointError(RunError):
    """A file is no checkpoint, or no longer the one that was written."""


@dataclass(frozen=True)
class CheckpointFile:
    """The checkpoint in a file."""

    path: Path
    locate: Locate = here  # where the file is on this machine

    def load(self) -> Checkpoint:
        """`load`."""
        return load(self.locate(self.path))


def loaded(task: TaskId, source: Source[Checkpoint] | None) -> Generator[Notice, None, Checkpoint | None]:
    """What a task continues from; none without a checkpoint, or with a notice if it is damaged.

    Raises RunError if it cannot be read.
    """
    try:
        return None if source is None else source.load()
    except DamagedCheckpointError as error:
        yield Notice(task, f"{error}: it starts from the beginning")
        return None


def save(path: Path, checkpoint: Checkpoint) -> None:
    """Write a checkpoint by atomic rename: its tensors as they are, task and iteration as metadata.

    Raises:
        RunError: the file cannot be written, with the system's reason.
    """
    names = {"task": str(checkpoint.task), "iteration": str(checkpoint.iteration)}
    metadata = names | {_SUM: str(_sum_of(checkpoint.tensors))}
    try:
        with atomic(path) as temporary:
            save_file(checkpoint.tensors, temporary, metadata)
    except (OSError, SafetensorError) as error:
        raise RunError(f"cannot write the checkpoint {path}: {error}; is the disk full?") from error


def load(path: Path) -> Checkpoint:
    """Read a checkpoint that `save` wrote; its tensors are on the CPU.

    Raises:
        DamagedCheckpointError: the file is truncated, no checkpoint, or has other bytes than were written.
        RunError: it cannot be read, or is missing.
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
        if tensors and int(metadata.get(_SUM, _sum_of(content))) != _sum_of(content):  # older ones have none
            raise ValueError("its bytes are not those that were written")
        return Checkpoint(TaskId.parse(metadata["task"]), int(metadata["iteration"]), content)
    except OSError as error:
        raise RunError(f"cannot read the checkpoint {path}: {error}") from error
    except (SafetensorError, KeyError, ValueError, InputError) as error:
        raise DamagedCheckpointError(f"{path} is not a whole checkpoint ({error})") from error


def _sum_of(tensors: Mapping[str, Tensor]) -> int:
    """CRC-32 of tensors, in the order of their names."""
    found = 0
    for _, tensor in sorted(tensors.items()):
        found = zlib.crc32(tensor.contiguous().numpy().reshape(-1).data.cast("B"), found)
    return found


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
        """Yields the saved Gaussians in order, sky last, at most `rows` at a time."""
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
                # the others would have been removed at the next densification
                yield piece.select(drawable(piece) | (torch.arange(len(piece)) >= piece.scene.stop))
