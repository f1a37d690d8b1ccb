"""The panoramas of a task that can be decoded: damaged ones are left out, up to a limit."""

from collections.abc import Iterable, Iterator, Mapping, Sequence

import torch
from torch import Tensor

from panolog.renderer import ops
from panolog.scene.errors import ImageError
from panolog.scene.images import PanoramaCache, View
from panolog.scene.model import Scene
from panolog.workers.events import LeftOut
from panolog.workers.specs import TaskSpec
from panolog.workers.tasks import TaskId

_LEFT_OUT = "views.left_out"  # in checkpoints: rows of the panoramas


def open_cache(
    spec: TaskSpec, scene: Scene, rows: Sequence[int], budget: int, room: int = 0
) -> PanoramaCache:
    """The decoded views of a task, on its device. Args: budget and room, bytes as in `PanoramaCache`."""
    return PanoramaCache(
        scene,
        rows,
        spec.width,
        budget,
        spec.locate,
        device=spec.device,
        room=room,
        threads=ops.threads(),
    )


class SoundViews:
    """The views of a task; a panorama that cannot be decoded is left out from its first use on.

    A file that cannot be read is no such panorama: that may pass, and a task that continued without it would
    not be repeatable.
    """

    def __init__(
        self, task: TaskId, scene: Scene, rows: Sequence[int], cache: PanoramaCache, damaged: float
    ) -> None:
        """Args: rows, of scene.panoramas; damaged, the fraction that may be left out, 1 = even all."""
        self.left_out: set[int] = set()  # rows
        self._notices: list[LeftOut] = []
        self._task, self._scene, self._rows, self._cache = task, scene, rows, cache
        limit = max(1, int(damaged * len(rows))) if damaged else 0
        self._limit = limit if damaged == 1 else min(limit, len(rows) - 1)

    def get(self, row: int) -> View | None:
        """The view of scene.panoramas[row]; None if it is left out.

        Raises:
            ImageError: it cannot be decoded, and no more may be left out.
            SceneError: it cannot be read.
        """
        if row in self.left_out:
            return None
        try:
            return self._cache.get(row)
        except ImageError as error:
            if len(self.left_out) == self._limit:
                raise ImageError(
                    f"{error} ({self._limit} of {len(self._rows)} panoramas may be left out: images.damaged)"
                ) from error
            self.left_out.add(row)
            name = self._scene.panoramas[row].name
            self._notices.append(LeftOut(self._task, f"{name} is left out: {error}", name))
            return None

    def each(self, rows: Sequence[int], ahead: int) -> Iterator[View]:
        """Some views in order, without those left out; so many ahead decode meanwhile. Raises as `get`."""
        for index, row in enumerate(rows):
            self._cache.prefetch(rows[index : index + ahead])
            if (view := self.get(row)) is not None:
                yield view

    def first(self, rows: Iterable[int]) -> View:
        """The first of some views that is not left out. Raises as `get`; StopIteration if there is none."""
        return next(view for view in map(self.get, rows) if view is not None)

    def tensors(self) -> dict[str, Tensor]:
        """Which are left out, for a checkpoint; none if all are sound."""
        return {_LEFT_OUT: torch.tensor(sorted(self.left_out))} if self.left_out else {}

    def restore(self, tensors: Mapping[str, Tensor]) -> None:
        """The inverse of `tensors`, also among others."""
        if _LEFT_OUT in tensors:
            self.left_out.update(tensors[_LEFT_OUT].tolist())

    def notices(self) -> list[LeftOut]:
        """The panoramas that were left out since the last call."""
        found, self._notices = self._notices, []
        return found
