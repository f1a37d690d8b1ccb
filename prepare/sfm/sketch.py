"""What is known of a place while its poses are found: enough to show it from above."""

import logging
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import pycolmap
from numpy.typing import NDArray

from panolog.prepare.panorama_files import PanoramaFile
from panolog.prepare.world.exif import Exif, read_exif
from panolog.prepare.world.georeference import georeference
from panolog.prepare.world.gps import collect_fixes, east_north_up
from panolog.scene.errors import InputError, in_one_line

_LOG = logging.getLogger(__name__)
_PAUSE_S = 2.0  # between two sketches at least
_SHARE = 0.01  # of the time that they may take
_POINTS = 50_000  # of a sketch, about
_FEWEST = 3  # panoramas with a pose, from which on a sketch shows a place

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Sketch:
    """Panoramas that have a pose, points that they see, and fixes of GPS, all in one frame."""

    names: tuple[str, ...]  # K, of the panoramas
    centers: Array  # (K, 3)
    points: Array  # (P, 3)
    fixes: Array  # (F, 3), also of panoramas without a pose; none where nothing connects them with the poses


class Sketcher:
    """Shows a reconstruction at work; what is shown has no influence on it."""

    def __init__(
        self, panoramas: Sequence[PanoramaFile], show: Callable[[Sketch], None], *, gps: bool
    ) -> None:
        """Args: show, called with each sketch; gps, whether fixes in the files count."""
        self._panoramas, self._show, self._gps = panoramas, show, gps
        self._next = 0.0  # time.monotonic() from which on another one is due

    @cached_property
    def _exifs(self) -> list[Exif]:
        return [read_exif(panorama.path) for panorama in self._panoramas]

    def begin(self) -> None:
        """Shows where GPS has the panoramas, before there are poses; nothing where it has none."""
        with self._harmless():
            fixes = collect_fixes([exif.fix if self._gps else None for exif in self._exifs])
            if fixes is not None:
                nothing = np.empty((0, 3))
                self._show(Sketch((), nothing, nothing, np.nan_to_num(fixes.enu)))

    def add(self, model: pycolmap.Reconstruction, numbers: Sequence[str]) -> None:
        """Shows a model that grows, unless it has just been shown. Args: numbers, `Workspace.numbers`."""
        began = time.monotonic()
        if began < self._next or model.num_reg_images() < _FEWEST:
            return
        with self._harmless():
            self._show(self._sketch(model, {number: row for row, number in enumerate(numbers)}))
        now = time.monotonic()
        self._next = now + max(_PAUSE_S, (now - began) / _SHARE)

    @contextmanager
    def _harmless(self) -> Iterator[None]:
        """Within it, errors end what is shown alone: a damaged file is named where it matters."""
        try:
            yield
        except (OSError, InputError, ValueError) as error:  # poses are worth more than a map
            _LOG.warning("no sketch of the place: %s", in_one_line(error))

    def _sketch(self, model: pycolmap.Reconstruction, row_of: dict[str, int]) -> Sketch:
        posed = [image for image in model.images.values() if image.has_pose]
        found = {row_of[image.name]: image.cam_from_world() for image in posed}
        rows = sorted(found)
        rotations = np.stack([found[row].rotation.matrix() for row in rows])
        centers = np.stack([found[row].inverse().translation for row in rows])
        chosen = list(model.points3D.values())[:: -(-model.num_points3D() // _POINTS) or 1]
        points = np.array([point.xyz for point in chosen], np.float64).reshape(-1, 3)
        exifs = [self._exifs[row] for row in rows]
        fixes = [exif.fix if self._gps else None for exif in exifs]
        world = georeference(rotations, centers, [exif.attitude for exif in exifs], fixes)
        every = [exif.fix for exif in self._exifs if exif.fix is not None]
        enu = np.empty((0, 3)) if world.gps is None else east_north_up(every, world.gps.fixes.origin)
        names = tuple(self._panoramas[row].name for row in rows)
        return Sketch(names, world.similarity.points(centers), world.similarity.points(points), enu)
