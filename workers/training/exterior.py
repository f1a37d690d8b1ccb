"""What surrounds a block: its cameras see it, but the block does not keep it (eq. 12)."""

import logging
import tempfile
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
import torch
from numpy.typing import NDArray

from panolog.partition.cells import Volume
from panolog.renderer.baked import Baked, bake
from panolog.renderer.camera import Camera
from panolog.renderer.process import release_memory
from panolog.renderer.render import render
from panolog.scene.errors import RunError, out_of_memory
from panolog.scene.files import read_at, write_all
from panolog.scene.gaussians import Gaussians
from panolog.scene.images import view_bytes
from panolog.scene.model import Panorama
from panolog.scene.tensors.transfer import Mover, Moving, pack, packed_bytes
from panolog.workers.training.iterations import AHEAD
from panolog.workers.training.task_config import CacheConfig

T = TypeVar("T")
_LOG = logging.getLogger(__name__)

_RELEASE = 8  # views: what baking one leaves free is not what the next one needs
CHECKED = 4  # views, at most, on which what is baked is compared with the full render
BAKED = 24  # bytes of a pixel of a baked view, at most about: its layers, and splats among own Gaussians
READING = 2  # baked views that are read from their file at a time: that in use and the next
PASSING = AHEAD + 1  # on a GPU besides those that stay there: those of iterations in flight, and the next


def inside(gaussians: Gaussians, cell: Volume | None) -> NDArray[np.bool_]:
    """(S,) the scene Gaussians in a block's cell; without one all of them."""
    if cell is None:
        return np.ones(gaussians.scene.stop, np.bool_)
    return cell.contains(gaussians.means[gaussians.scene].cpu().numpy())


def exterior_last(gaussians: Gaussians, cell: Volume | None) -> Gaussians:
    """The Gaussians inside of a block's cell first; the others count as sky: they neither train nor densify.

    They are not retained either (eq. 12), so what they are called has no other effect.
    """
    within = inside(gaussians, cell)
    order = np.concatenate([within.nonzero()[0], (~within).nonzero()[0]])
    rows = torch.from_numpy(np.concatenate([order, np.arange(len(within), len(gaussians))]))
    tensors = {name: tensor[rows] for name, tensor in gaussians.tensors().items()}
    return gaussians.with_tensors(tensors, sky=len(gaussians) - int(within.sum()))


@dataclass(frozen=True)
class Rooms:
    """Bytes that a task may keep of what it has once for each panorama."""

    host: int  # decoded, in the host's memory
    device: int  # decoded, on a GPU
    baked: int  # of `BakedViews`, where the task computes

    @staticmethod
    def of(
        cache: CacheConfig, device: str, panorama: Panorama, width: int, *, bakes: bool, taken: int = 0
    ) -> "Rooms":
        """The rooms that the settings give.

        Args: panorama, any of the task's; width in pixels; taken, `TaskSpec.taken`.
        """
        host, room = int(cache.memory * 2**30), max(0, int((cache.device or 0) * 2**30) - taken)
        if not bakes:
            return Rooms(host, room, 0)
        view, pixels = view_bytes(panorama, width), width * (width // 2)
        whole = host if device == "cpu" else room
        images = whole * view // (view + BAKED * pixels)
        rest = whole - images
        return Rooms(images, 0, rest) if device == "cpu" else Rooms(host, images, rest)


class BakedViews:
    """What some cameras see of an exterior: as many as there is room for stay, the others are in a file.

    Those that come first stay. An epoch uses each view once, so no other choice would read less. The file has
    no name and ends with its process at the latest.
    """

    def __init__(self, room: int, device: torch.device) -> None:
        """Args: room, bytes of those that stay on the device of the block."""
        self.nbytes = 0  # of all
        self._room, self._device = room, device
        self._staying: dict[int, Baked] = {}
        self._filed: dict[int, tuple[int, Baked]] = {}  # where one begins, and its layout, without memory
        self._coming: dict[int, Future[Moving]] = {}
        self._used: tuple[int, Baked] | None = None
        self._reader = ThreadPoolExecutor(1, "baked")
        self._mover = Mover.to(device)

    def __contains__(self, row: int) -> bool:
        return row in self._staying or row in self._filed

    def __len__(self) -> int:
        return len(self._staying) + len(self._filed)

    def add(self, row: int, baked: Baked) -> None:
        """Takes one. Raises RunError if it has to go into the file and the disk has no room."""
        if self.nbytes + baked.nbytes <= self._room:
            self._staying[row] = baked.to(self._device)
        else:
            self._filed[row] = self._write(baked)
        self.nbytes += baked.nbytes

    def prefetch(self, rows: Sequence[int]) -> None:
        """Begins to read those that `get` will return next, and to move them; `READING` of them at most."""
        used = None if self._used is None else self._used[0]
        ahead = [row for row in rows[:READING] if row in self._filed and row != used]
        reading = self._coming
        self._coming = {row: reading.get(row) or self._reader.submit(self._read, row) for row in ahead}

    def get(self, row: int) -> Baked:
        """One, on the device. Raises KeyError if it was not added."""
        if row in self._staying:
            return self._staying[row]
        if self._used is None or self._used[0] != row:
            coming = self._coming.pop(row, None) or self._reader.submit(self._read, row)
            tensors = self._mover.end(coming.result())
            self._used = row, Baked(unit=self._filed[row][1].unit, **tensors)
        return self._used[1]

    def close(self) -> None:
        """Ends the thread that reads, and the file."""
        self._reader.shutdown(cancel_futures=True)
        if self._filed:
            self._file.close()

    def _write(self, baked: Baked) -> tuple[int, Baked]:
        if not self._filed:
            self._file = tempfile.TemporaryFile(prefix="panolog-baked-", buffering=0)  # noqa: SIM115
        at, tensors = self._file.tell(), baked.tensors()
        packed = torch.empty(packed_bytes(tensors), dtype=torch.uint8)
        pack(tensors, packed)
        try:
            write_all(self._file, packed.numpy().data)
        except OSError as error:
            raise RunError(
                f"{tempfile.gettempdir()}: what is baked of a block's exterior cannot be written"
                f" ({error.strerror}); set TMPDIR to a folder with room, or raise cache.memory"
            ) from error
        return at, baked.to("meta")

    def _read(self, row: int) -> Moving:
        at, layout = self._filed[row]
        return self._mover.begin(
            layout.tensors(), lambda memory: read_at(self._file, at, memory.numpy().data)
        )


class Exterior:
    """A block's frozen exterior, baked for each of its cameras when it is first needed.

    That is on the device of the block, or on the CPU from when a GPU has no room for the whole model.
    """

    def __init__(self, model: Gaussians, near: float, unit: float, room: int, device: torch.device) -> None:
        """Args: model of `exterior_last`; near in world units; unit of `bake`; room and device as above."""
        self.model: Gaussians | None = model  # None once all cameras are baked
        self.views = BakedViews(room, device)
        self._near, self._unit, self._device = near, unit, device

    @staticmethod
    def own(model: Gaussians) -> Gaussians:
        """What the block trains."""
        scene = model.scene
        return model.with_tensors({name: tensor[scene] for name, tensor in model.tensors().items()}, sky=0)

    def of(self, row: int, camera: Camera) -> Baked:
        """What one camera sees of it. Raises KeyError if it is not baked and the model is dropped.

        Raises RunError as `BakedViews.add`.
        """
        if row not in self.views:
            if self.model is None:
                raise KeyError(row)
            self.views.add(row, self._where_there_is_room(lambda model: self._bake(model, camera)))
            if len(self.views) % _RELEASE == 0:
                release_memory()
        return self.views.get(row)

    def finish(self, cameras: Mapping[int, Camera]) -> str:
        """Drops the model: all of these cameras, by row, are baked. Returns what that took, for the log."""
        differences = self._where_there_is_room(
            lambda model: self.differences(self.own(model), model, cameras)
        )
        self.model = None
        release_memory()
        mebibytes = self.views.nbytes / 2**20
        what = f"what surrounds the block for {len(cameras)} panoramas, {mebibytes:.0f} MiB"
        return f"baked {what}; its colours {differences}"

    def differences(self, own: Gaussians, whole: Gaussians, cameras: Mapping[int, Camera]) -> str:
        """How far what is baked is from the full render on some of the cameras, for the log.

        Args: own, what the block trains, as it is by now; whole, the same with all that was baked, on the
        same device, which renders.
        """
        device = whole.means.device
        rows, found = list(cameras), [torch.zeros(1, device=device)]
        for row in rows[:: -(-len(rows) // CHECKED)]:
            camera, baked = cameras[row], self.views.get(row).to(device)
            full = render(whole, camera, near=self._near).color
            parts = render(own, camera, near=self._near, exterior=baked).color
            found.append((full - parts).abs().amax(2)[baked.active(camera.width, camera.height)])
        all_of = torch.cat(found)
        most, mean = float(all_of.max()), float(all_of.mean())
        return f"differ from the full render by at most {most:.4f}, {mean:.5f} on average"

    def _bake(self, model: Gaussians, camera: Camera) -> Baked:
        return bake(model, model.scene.stop, camera, near=self._near, unit=self._unit)

    def _where_there_is_room(self, compute: Callable[[Gaussians], T]) -> T:
        """What is computed of the model: on a GPU, unless that runs out of memory, now or before."""
        assert self.model is not None, "it is dropped"
        try:
            self.model = self.model.to(self._device)
            return compute(self.model)
        except (RuntimeError, RunError) as error:
            if self._device.type == "cpu" or not out_of_memory(error):
                raise
        self._device = torch.device("cpu")  # not in the clause above: its error holds what has been computed
        _LOG.info("the GPU has no room to bake what surrounds the block: the CPU bakes it")
        return self._where_there_is_room(compute)
