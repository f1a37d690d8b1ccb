"""When and what a task in training shows: a panorama as it renders it now, and in Stage I its model.

None of it has an influence on what is trained.
"""

import logging
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cached_property

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from panolog.renderer.baked import Baked
from panolog.renderer.render import encode_jpeg, hatched, to_bytes
from panolog.scene.errors import PanologError
from panolog.scene.files import Locate
from panolog.scene.gaussians import EXACT, Gaussians
from panolog.scene.image_files import decode_with_alpha
from panolog.scene.images import View
from panolog.scene.model import Scene

PREVIEW_WIDTH = 1024  # pixels, at most
MOST = 300_000  # scene Gaussians of a snapshot: 17 MB
WHOLE = "gaussians"  # in a snapshot: how many the model has, with those that are left out
EARLY = (1, 10, 30, 100, 300)  # iterations with a preview: in minutes one sees whether poses and pictures fit
SHARE = 0.01  # of the time of a task that its previews by time may take
_GROWTH = 0.05  # of a task's time until the next one: days of training have a few dozen more than a minute
_LOG = logging.getLogger(__name__)

Pixels = NDArray[np.uint8]  # (H, W, 3) RGB


class PreviewClock:
    """When a picture of a task in training is due: early at first, later also by time."""

    def __init__(self, every: int, seconds: float) -> None:
        """Args: every, iterations; seconds between two at first: `PreviewConfig`."""
        self._every, self._seconds = every, seconds
        self._began = time.monotonic()
        self._next = self._began + seconds

    def due(self, iteration: int) -> bool:
        """Whether there should be one after an iteration."""
        regular = iteration in EARLY or iteration % self._every == 0
        return regular or time.monotonic() >= self._next

    @contextmanager
    def timed(self) -> Iterator[None]:
        """The time in which one is made and sent, after which the next one waits."""
        began = time.monotonic()
        yield
        now = time.monotonic()
        self._next = now + max(self._seconds, (now - began) / SHARE, (now - self._began) * _GROWTH)


def picture(rendered: Tensor, photograph: Pixels, around: Baked | None = None) -> bytes:
    """JPEG of a render (H, W, 3) above its photograph (H, W, 3), at most `PREVIEW_WIDTH` pixels wide.

    Args: around, what a block does not train of it: where nothing else is drawn, the picture is hatched.
    """
    pixels = to_bytes(rendered)
    if around is not None:
        height, width = photograph.shape[:2]
        left_out = ~around.active(width, height).cpu().numpy()
        pixels[left_out] = hatched(photograph)[left_out]
    return encode_jpeg(np.concatenate([pixels, photograph]), PREVIEW_WIDTH)


class HeldOut:
    """A panorama that no task trains on, for pictures of a training; decoded at its first use."""

    def __init__(self, scene: Scene, row: int | None, width: int, locate: Locate) -> None:
        """Args: row, of scene.panoramas, None if there is none; width in pixels; locate, where files are."""
        self.rows = () if row is None else (row,)
        self._scene, self._width, self._locate = scene, width, locate

    def photograph(self, otherwise: Callable[[], View]) -> tuple[int, Pixels]:
        """The row and the pixels (width / 2, width, 3) of the panorama that pictures show.

        Args: otherwise, gives the view in its place if it cannot be decoded, as training does not need it.
        """
        if self._decoded is not None:
            return self._decoded
        view = otherwise()
        return view.row, view.image.cpu().numpy()

    @cached_property
    def _decoded(self) -> tuple[int, Pixels] | None:
        for row in self.rows:
            try:
                return row, decode_with_alpha(self._locate(self._scene.panoramas[row].image), self._width)[0]
            except (PanologError, OSError) as error:
                _LOG.warning("no picture of a held-out panorama: %s", error)
        return None


def snapshot(model: Gaussians, middle: NDArray[np.float64], most: int = MOST) -> dict[str, Tensor]:
    """Copies on the CPU of what a 3D view needs of a model: without harmonics beyond degree 0, or moments.

    Of more than `most` scene Gaussians those are kept that cover most around the cameras. Of `load` in
    `checkpoint` it is a checkpoint, from which nothing continues.

    Args: middle (3,) of the cameras, world units.
    """
    tensors = model.tensors() | {"shN": model.shN[:, :0]}
    if model.scene.stop > most:
        rows = _covering(model, middle, most)
        sky = torch.arange(model.scene.stop, len(model), device=rows.device)
        rows = torch.cat([rows, sky])
        tensors = {name: tensor[rows] for name, tensor in tensors.items()}
    kept = {name: tensor.detach().to("cpu", copy=True).contiguous() for name, tensor in tensors.items()}
    kept |= {"sky": torch.tensor(model.sky), WHOLE: torch.tensor(len(model))}
    return kept | ({EXACT: torch.tensor(1)} if model.exact else {})


def _covering(model: Gaussians, middle: NDArray[np.float64], most: int) -> Tensor:
    """(most,) ascending rows of the scene: those with most opacity times solid angle, as seen from `middle`.

    Those nearer than half of them count as if they were at the median distance: the cameras are among them.
    """
    scene = model.scene
    scales, means = model.scales[scene], model.means[scene]
    distance = (means - torch.as_tensor(middle, dtype=means.dtype, device=means.device)).norm(dim=1)
    distance = distance.clamp_min(float(distance.median()))
    covers = scales.sum(1) - scales.min(1).values - 2 * distance.log()
    covers += torch.nn.functional.logsigmoid(model.opacities[scene])
    rows: Tensor = covers.nan_to_num(nan=-torch.inf).topk(most).indices.sort().values
    return rows
