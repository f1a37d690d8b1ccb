"""The model in a checkpoint, in pieces: the driver, whose memory is small, makes PLYs of it."""

from collections.abc import Iterator
from pathlib import Path

import torch
from safetensors import SafetensorError, safe_open

from panolog.scene.errors import RunError
from panolog.scene.gaussians import Gaussians
from panolog.workers.training.optimizer import AVERAGE, EXACT, MOMENT

_ROWS = 2**16  # of a model in memory at a time


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
