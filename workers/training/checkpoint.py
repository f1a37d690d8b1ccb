"""Checkpoints on disk: one safetensors file, complete or absent."""

from dataclasses import dataclass
from pathlib import Path

from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file

from panolog.scene.errors import InputError, RunError
from panolog.scene.files import Locate, atomic, here
from panolog.workers.events import Checkpoint
from panolog.workers.tasks import TaskId


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
