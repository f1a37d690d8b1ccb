"""Movers: what one panorama shows and those around it do not, such as passers-by, found without a network.

Each visit of a view leaves the colours and errors of its cells, a coarse grid of its picture, and how far
away the model is in each. A cell shows what is not of the place if its error is much higher than that of the
same place in all of the nearest views, and if no colour there is on the way from the render to this
photograph.
What is merely not learnt yet is wrong in the views around, too, or they show it. Such cells are left out of
the loss, as by a mask, until a later visit finds otherwise.

Errors are differences of cells' mean colours, and count over 3 × 3 cells: fine texture that is a little out
of place cancels, a figure in another colour does not. All arithmetic is exact by IEEE 754, element by
element, so that no number of threads changes a verdict.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from torch import Tensor
from torch.nn import functional

from panolog.renderer import ops
from panolog.scene.images import View
from panolog.scene.model import Scene
from panolog.workers.capture.config import MoversConfig

Array = NDArray[np.float64]

CELLS = 128  # columns of the grid, at most; a person five metres away is about 7 cells high
_PIXELS = 4  # of the training width in a cell, at least
_NEIGHBOURS = 4  # views around one that it is compared with
_LEAST = 2  # of them that must have been visited, and see the place nearly as large
_FARTHER = 1.5  # times the distance from a view, at most, from which these must see the same place
_FLOOR = 0.03  # error, of 1, that any view may have: noise, reflections, clouds
_STAYS = 1.0  # times the error of the views around: what was a mover stays one above it
_GROWS = 0.8  # the same for a cell next to one
_STEPS = 2  # cells by which a mover grows, at most
_SHOWN = 0.3  # part of the way from the render to the photograph that the views around may have gone
_BLACK = 1e-4  # squared error below which there is no such way
_EARLY = 1.5  # times `MoversConfig.factor` when it begins
_SETTLES = 0.3  # part of a task after which the factor is as configured
_BEGINS = 0.02  # part of a task before which nothing is judged, nor before each view was visited
_MOST = (
    0.1  # of a view's sphere; a view that disagrees in more is off as a whole, and nothing in it is a mover
)
_BATCH = 16  # iterations between two judgements, which are of their views together
_WEIGHTS = 1 << 10  # by which shares of the sphere are summed as integers
_VISITS = "movers.visits"
_OF_VIEW = 1 + 1 + 3 + 1  # bytes of a cell of a view: moving, error, colour, whether a mask leaves it
_OF_BATCH = 3 + 2  # of a cell of an iteration: colour, inverse depth
_UNSEEN = 255  # error of a view before its first visit, in 255ths as all errors and colours


@dataclass(frozen=True, eq=False)
class Views:
    """Where the views of a task are; world units are divided by the distance between neighbours."""

    rotations: Tensor  # (V, 3, 3) float32, world to camera
    centers: Tensor  # (V, 3) float32
    nearest: Tensor  # (V, K) int64, of each the views around it
    unit: float  # that distance, world units

    @staticmethod
    def of(scene: Scene, views: Sequence[int], device: str) -> "Views":
        """The neighbours of three views or more."""
        centers = scene.centers[list(views)]
        count = min(_NEIGHBOURS, len(views) - 1)
        distances, found = cKDTree(centers).query(centers, count + 1)
        own = found == np.arange(len(views))[:, None]
        own[~own.any(1), -1] = True  # of views at one place it may not be among the first
        unit = float(np.median(distances[:, 1])) or 1.0
        rotations = np.stack([scene.panoramas[row].rotation for row in views])
        scaled = (centers - centers.mean(0)) / unit
        return Views(
            _float32(rotations, device),
            _float32(scaled, device),
            torch.from_numpy(found[~own].reshape(len(views), count)).to(device),
            unit,
        )


class Grid:
    """The cells of an equirectangular picture."""

    def __init__(self, columns: int, device: str) -> None:
        self.shape = columns // 2, columns
        azimuth = (np.arange(columns + 1) / columns - 0.5) * 2 * np.pi
        elevation = (np.arange(columns // 2 + 1) / (columns // 2) - 0.5) * np.pi
        middles = azimuth[:-1] + np.pi / columns, (elevation[:-1] + np.pi / columns)[:, None]
        level = np.cos(middles[1])
        parts = (level * np.sin(middles[0]), np.sin(middles[1]) + 0 * middles[0], level * np.cos(middles[0]))
        self.rays = tuple(_float32(part, device) for part in parts)  # x, y, z (h, w) in camera axes
        self._columns = _float32(_turn(np.sin(azimuth), np.cos(azimuth))[1:-1], device)
        self._rows = _float32(np.sin(elevation)[1:-1], device)
        weights = np.rint(np.broadcast_to(level, self.shape) * _WEIGHTS)
        self.weights = torch.from_numpy(weights.astype(np.int64)).to(device)  # (h, w) areas on the sphere

    def at(self, x: Tensor, y: Tensor, z: Tensor) -> tuple[Tensor, Tensor]:
        """Rows and columns of the cells that show points (...) in camera axes."""
        flat = (x.abs() + z.abs()).clamp(min=1e-12)
        turn = torch.where(x < 0, z / flat - 1, 1 - z / flat)
        rise = y / (x * x + y * y + z * z).sqrt().clamp(min=1e-12)
        rows = torch.bucketize(rise, self._rows, right=True)
        return rows, torch.bucketize(turn, self._columns, right=True)


def _float32(values: Array, device: str) -> Tensor:
    return torch.from_numpy(np.asarray(values, np.float32)).to(device)


def _turn(x: Array, z: Array) -> Array:
    """A number that grows with the azimuth atan2(x, z) from -2 to 2, by division alone."""
    share = z / (np.abs(x) + np.abs(z))
    turn: Array = np.where(x < -1e-12, share - 1, 1 - share)
    return turn


@dataclass(frozen=True, eq=False, kw_only=True)
class Visit:
    """What an iteration has found in its view, on the device of the training."""

    row: int  # of scene.panoramas
    iteration: int
    image: Tensor  # (H, W, 3) uint8, the photograph
    color: Tensor  # (H, W, 3) float32 rendered, before the exposure
    affine: Tensor | None  # (2, 3) float32, `View.exposure` in this iteration
    inverse_depth: Tensor  # (H, W) float32 rendered, 1 / world units
    status: Tensor | None  # (1,) int32, on a card: not 0 where the iteration did not take place
    exposure: Tensor | None = None  # (3, 5) float64, `ops.photometric`


class Movers:
    """The movers in the views of one task."""

    def __init__(
        self, views: Views, rows: Sequence[int], config: MoversConfig, grid: Grid, task: int
    ) -> None:
        """Nothing is known yet. Args: rows of scene.panoramas, in the order of `views`; task, iterations."""
        self._views, self._grid, self._factor, self._task = views, grid, config.factor, task
        self._at = {row: at for at, row in enumerate(rows)}
        self._begins = min(max(_BEGINS * task, len(rows)), task / 3)
        self._most = int(_MOST * int(grid.weights.sum()))
        device, shape = views.centers.device, grid.shape
        self._reads = ops.launcher(device) is None  # on a card the host would have to wait
        self._numbers = torch.arange(max(len(rows), _BATCH), device=device)
        self._visits: dict[int, int] = {}  # the last views by iteration
        self._used: dict[int, Tensor] = {}  # (h, w) bool by view: cells that no mask touches
        count = len(rows)
        known = {
            "moving": torch.zeros((count, *shape), dtype=torch.bool),
            "errors": torch.full((count, *shape), _UNSEEN, dtype=torch.uint8),
            "colors": torch.zeros((count, 3, *shape), dtype=torch.uint8),  # of photographs, without exposure
            "rendered": torch.zeros((_BATCH, 3, *shape), dtype=torch.uint8),  # of the last iterations
            "inverse": torch.zeros((_BATCH, *shape), dtype=torch.float16),  # depths, 1 / `Views.unit`
        }
        self._state = {f"movers.{name}": tensor.to(device) for name, tensor in known.items()}

    @staticmethod
    def of(
        scene: Scene, rows: Sequence[int], config: MoversConfig, device: str, width: int, iterations: int
    ) -> "Movers | None":
        """None if they are not looked for, or there are too few views to compare.

        Args: rows of scene.panoramas; width of the pictures in pixels; iterations of the task.
        """
        columns = _columns(config, len(rows), width)
        if not columns:
            return None
        return Movers(Views.of(scene, rows, device), rows, config, Grid(columns, device), iterations)

    def still(self, view: View) -> Tensor | None:
        """(H, W) bool, where a view shows the place as far as known now; None: everywhere."""
        at, (height, width) = self._at[view.row], view.image.shape[:2]
        if view.mask is not None and at not in self._used:
            share = functional.adaptive_avg_pool2d(view.mask[None].float(), self._grid.shape)[0]
            self._used[at] = share > 0.999
        moving = self._state["movers.moving"][at]
        if self._reads and not moving.any():
            return None
        wide = functional.interpolate(moving[None, None].float(), size=(height, width), mode="nearest")
        return wide[0, 0] == 0

    def step(self, visit: Visit) -> None:
        """Notes what a visit has found, and judges the last views when it is time."""
        at, slot = self._at[visit.row], visit.iteration % _BATCH
        shown = self._cells(visit.color).clamp(0, 1)
        seen = self._cells(visit.image.float()) / 255
        if visit.affine is not None:
            seen = (seen - visit.affine[1][:, None, None]) / visit.affine[0][:, None, None]
        seen = seen.clamp(0, 1)
        red, green, blue = ((shown - seen) * (shown - seen)).unbind(0)
        error = ((red + green + blue) / 3).sqrt()
        if at in self._used:
            error = torch.where(self._used[at], error, 0)
        error = (_box(error[None])[0] * 255 + 0.5).clamp(max=_UNSEEN - 1)
        inverse = (self._cells(visit.inverse_depth[..., None])[0] * self._views.unit).clamp(0, 1e4)
        for name, index, new in (
            ("movers.errors", at, error),
            ("movers.colors", at, seen * 255 + 0.5),
            ("movers.rendered", slot, shown * 255 + 0.5),
            ("movers.inverse", slot, inverse),
        ):
            known = self._state[name][index]
            value = new.to(known.dtype)
            value = value if visit.status is None else torch.where(visit.status[0] == 0, value, known)
            known.copy_(value, non_blocking=True)
        self._visits[visit.iteration] = at
        if slot == 0:
            self._judge(visit.iteration, visit.status)

    def _cells(self, picture: Tensor) -> Tensor:
        """Means (C, h, w) of a picture (H, W, C) in the cells."""
        (height, width, channels), (h, w) = picture.shape, self._grid.shape
        if not self._reads or height % h or width % w:
            return functional.adaptive_avg_pool2d(picture.permute(2, 0, 1), self._grid.shape)
        rows = _sum(picture.reshape(h, height // h, width, channels))  # a sixth of the pooling's time
        sums = _sum(rows.reshape(h, w, width // w, channels), dim=2)
        return sums.permute(2, 0, 1) / (height // h * (width // w))

    def _judge(self, iteration: int, status: Tensor | None) -> None:
        """What moves in the last views, by what was last noted of them and of those around them."""
        last = {at: i % _BATCH for i, at in sorted(self._visits.items()) if i > iteration - _BATCH}
        self._visits = {i: at for i, at in self._visits.items() if i > iteration - _BATCH}
        if iteration <= self._begins:
            return
        views, slots = self._picked(last), self._picked(last.values())
        score, shown = self._compared(views, slots)
        before = self._state["movers.moving"][views]
        early = max(0.0, 1 - iteration / (_SETTLES * self._task))
        clear = (score > self._factor * (1 + (_EARLY - 1) * early)) | (before & (score > _STAYS))
        moving = clear & (shown <= _SHOWN)
        for _ in range(_STEPS):
            moving = (functional.max_pool2d(_around(moving.float()), 3, 1) > 0) & (score > _GROWS)
        area = (moving * self._grid.weights).flatten(1).sum(1)
        moving &= (area <= self._most)[:, None, None]
        taken = moving if status is None else torch.where(status[0] == 0, moving, before)
        self._state["movers.moving"][views] = taken

    def _picked(self, numbers: Iterable[int]) -> Tensor:
        """(B,) int64 of them; `torch.tensor` would make the host wait for a card."""
        return torch.stack([self._numbers[number] for number in numbers])

    def _compared(self, views: Tensor, slots: Tensor) -> tuple[Tensor, Tensor]:
        """Cells of views (B,) that were rendered into slots (B,), and the same places in the views around.

        Returns (B, h, w) each: errors over the highest of these places, 0 where too few of the views around
        can tell; and how far their colours are, at most, on the way from render to photograph.
        """
        state, unit = self._state, 1 / 255
        own, colors = state["movers.errors"][views] * unit, state["movers.colors"][views] * unit
        rendered, inverse = state["movers.rendered"][slots] * unit, state["movers.inverse"][slots].float()
        way = (colors - rendered).unbind(1)
        length = _box(_dot(way, way)) + _BLACK
        highest, shown = torch.zeros_like(own), torch.full_like(own, -1.0)
        known = torch.zeros_like(own, dtype=torch.int64)
        for others in self._views.nearest[views].unbind(1):
            place = self._seen_from(views, others, inverse)
            row, column = self._grid.at(*place)
            which = others[:, None, None]
            error = state["movers.errors"][which, row, column]
            visited = error != _UNSEEN
            found = [state["movers.colors"][which, channel, row, column] * unit for channel in range(3)]
            gone = [color - start for color, start in zip(found, rendered.unbind(1), strict=True)]
            shown = torch.where(visited, torch.maximum(shown, _box(_dot(gone, way)) / length), shown)
            highest = torch.where(visited, torch.maximum(highest, error * unit), highest)
            known += visited & (_dot(place, place) < _FARTHER * _FARTHER)
        return torch.where(known >= _LEAST, own / (_FLOOR + highest), 0), shown

    def _seen_from(self, views: Tensor, others: Tensor, inverse: Tensor) -> list[Tensor]:
        """x, y, z (B, h, w) of what views (B,) show, in the axes of others (B,), over its distances."""
        at = self._views
        here, there = (at.rotations[which][..., None, None] for which in (views, others))
        apart = (at.centers[views] - at.centers[others])[..., None, None]
        rays = self._grid.rays
        world = [_dot(here[:, :, axis].unbind(1), rays) + apart[:, axis] * inverse for axis in range(3)]
        return [_dot(there[:, axis].unbind(1), world) for axis in range(3)]

    def learnt(self) -> NDArray[np.bool_]:
        """(V, h, w) `Panorama.movers` of each view."""
        moving: NDArray[np.bool_] = self._state["movers.moving"].cpu().numpy().copy()
        return moving

    def tensors(self) -> dict[str, Tensor]:
        """For a checkpoint."""
        visits = torch.tensor(sorted(self._visits.items()), dtype=torch.int64).reshape(-1, 2)
        return self._state | {_VISITS: visits}

    def restore(self, tensors: Mapping[str, Tensor]) -> None:
        """The inverse of `tensors`; of a checkpoint without them, the start."""
        if _VISITS in tensors:
            device = self._numbers.device
            self._state = {name: tensors[name].to(device) for name in self._state}
            self._visits = dict(tensors[_VISITS].tolist())


def state_bytes(config: MoversConfig, views: int, width: int) -> int:
    """Bytes that `Movers` keeps of so many views; its checkpoints have them too. Args: width, in pixels."""
    columns = _columns(config, views, width)
    return columns * (columns // 2) * (_OF_VIEW * views + _OF_BATCH * _BATCH)


def _columns(config: MoversConfig, views: int, width: int) -> int:
    """The columns of the grid; 0 if movers are not looked for, or there are too few views to compare."""
    columns = min(CELLS, width // _PIXELS) & ~1
    return columns if config.weigh and views > _LEAST else 0


def _sum(values: Tensor, dim: int = 1) -> Tensor:
    """The sum along a dimension, in its order."""
    total, *others = values.unbind(dim)
    for other in others:
        total = total + other
    return total


def _dot(one: Sequence[Tensor], two: Sequence[Tensor]) -> Tensor:
    """Products of three pairs, summed in one order."""
    return one[0] * two[0] + one[1] * two[1] + one[2] * two[2]


def _box(cells: Tensor) -> Tensor:
    """Means (B, h, w) over 3 × 3 cells."""
    return functional.avg_pool2d(_around(cells), 3, 1)


def _around(cells: Tensor) -> Tensor:
    """Cells (B, h, w) with one more on each side: round at ±180°, the same again beyond the poles."""
    wide = torch.cat([cells[..., -1:], cells, cells[..., :1]], dim=-1)
    return torch.cat([wide[..., :1, :], wide, wide[..., -1:, :]], dim=-2)
