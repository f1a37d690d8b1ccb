"""What is measured along the faces between the blocks of a merged model, and in which strips of images.

A strip is what an image shows within one baseline (eq. 8) of a face. In the strips of some cameras near a
face

- the merged model is compared with the photographs: its error, and the step of its error from one side of
  the face to the other, which a viewer would see as a line. Along planes within the two blocks the same is
  the floor: what there is where nothing was put together. The ratio of both also depends on what the scene
  has there, so it is compared with that of the Stage I model, which has no seams, in the same strips.
- what the two blocks show is compared: each is the merged model in its own cell and Stage I elsewhere, which
  is what a block with a frozen exterior was trained with. Virtual cameras between both sides look, too.

What models show to a camera is as the exposure of its photograph has it, where that is known.
"""

from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal, TypeAlias, TypeVar

from torch import Tensor

from panolog.partition.faces import Plane
from panolog.partition.plan import Plan
from panolog.scene.gaussians import Gaussians
from panolog.workers.comparison import with_block
from panolog.workers.events import Event, SeamMeasured
from panolog.workers.merge import retained
from panolog.workers.seams import schema
from panolog.workers.seams.cameras import Looks
from panolog.workers.seams.pictures import Picture
from panolog.workers.seams.schema import Seam
from panolog.workers.seams.strips import Colors, Difference, Errors, Look, Seen, Strip, see, strip_of
from panolog.workers.sound_views import SoundViews, open_cache
from panolog.workers.specs import Source, TaskSpec
from panolog.workers.tasks import Progress

_IMAGE_MEMORY = 2**29  # bytes of decoded panoramas

T = TypeVar("T")
Steps: TypeAlias = Generator[Event, None, T]  # yields progress and notices


@dataclass(frozen=True, eq=False)
class Seams:
    """What a task is to measure besides the held-out panoramas."""

    faces: tuple[Plane, ...]
    plan: Source[Plan]
    coarse: Source[Gaussians]  # the Stage I model


@dataclass(frozen=True, eq=False)
class _Shot:
    """A strip of one camera."""

    face: Plane
    look: Look
    strip: Strip
    truth: Colors | None  # (S, 3) of the photograph
    exposure: Tensor | None  # (2, 3) `View.exposure` of it


@dataclass
class _Measured:
    """The errors of both models in the same strips."""

    merged: Errors = field(default_factory=Errors)
    coarse: Errors = field(default_factory=Errors)


class SeamMeasurement:
    """Measures the seams of a merged model. The host has it and the Stage I model, a GPU one at a time."""

    def __init__(
        self, spec: TaskSpec, seams: Seams, near: float, progress: Callable[[], Iterator[Progress]]
    ) -> None:
        """Chooses the cameras. Args: near in world units, as in training; progress, called at renders."""
        self._spec, self._near, self._progress = spec, near, progress
        self._scene, self._plan, self._coarse = spec.scene.load(), seams.plan.load(), seams.coarse
        self._looks = Looks.of(self._scene, self._plan, seams.faces)

    @property
    def renders(self) -> int:
        """How many `measure` makes."""
        return self._looks.renders

    def measure(self, merged: Gaussians) -> Iterator[Event]:
        """Yields one SeamMeasured for each face, and the progress of each render.

        Raises InputError if the Stage I model or a panorama cannot be read.
        """
        coarse, rows = self._coarse.load(), self._looks.rows
        with open_cache(self._spec, self._scene, rows, _IMAGE_MEMORY) as cache:
            views = SoundViews(self._spec.task, self._scene, rows, cache, damaged=1.0)
            floors: dict[tuple[int, int], _Measured] = {}
            for key, planes in self._looks.planes.items():
                shots = yield from self._shots(merged, planes, views)
                floors[key] = yield from self._errors(coarse, shots)
            for face, found in self._looks.faces.items():
                pictures: list[Picture] = []
                shots = yield from self._shots(merged, {face: found}, views, pictures)
                errors = yield from self._errors(coarse, shots)
                difference = yield from self._difference(face, merged, coarse, shots, pictures)
                floor = [floors[block, face.axis] for block in (face.below, face.above)]
                seam = self._report(face, found, errors, floor, difference)
                yield SeamMeasured(self._spec.task, seam, pictures[0].files() if pictures else {})

    def _see(self, model: Gaussians, look: Look, exposure: Tensor | None) -> Seen:
        return see(model, look, self._spec.width, self._near, exposure)

    def _shots(
        self,
        merged: Gaussians,
        looks: Mapping[Plane, Sequence[Look]],
        views: SoundViews,
        best: list[Picture] | None = None,
    ) -> Steps[list[_Shot]]:
        """The strips of some faces as the merged model shows them.

        Args: best, gets a picture from the camera that sees most of them in one direction, of those with a
        photograph.
        """
        shots, model = list[_Shot](), merged.to(self._spec.device)
        for face, look in ((face, look) for face, found in looks.items() for look in found):
            view = None if look.row is None else views.get(look.row)
            yield from views.notices()
            mask, exposure = (None, None) if view is None else (view.mask, view.exposure)
            seen = self._see(model, look, exposure)
            strip = strip_of(face, self._plan.aabb, self._plan.baseline, look, seen, mask)
            truth = None if view is None else view.image.cpu().numpy()
            of_strip = None if truth is None else truth.reshape(-1, 3)[strip.pixels]
            shots.append(_Shot(face, look, strip, of_strip, exposure))
            if best is not None and truth is not None:
                picture = Picture.of(look, strip, truth, seen.color)
                best[:] = [max((*best, picture), key=lambda each: each.area)]
            yield from self._progress()
        return shots

    def _errors(self, coarse: Gaussians, shots: Sequence[_Shot]) -> Steps[_Measured]:
        """The errors of both models in some strips."""
        measured, model, side = _Measured(), coarse.to(self._spec.device), self._plan.baseline
        for shot in shots:
            if shot.truth is not None:
                color = self._see(model, shot.look, shot.exposure).at(shot.strip.pixels).color
                measured.merged.add(shot.face, shot.strip, shot.strip.seen.color, shot.truth, side)
                measured.coarse.add(shot.face, shot.strip, color, shot.truth, side)
            yield from self._progress()
        return measured

    def _difference(
        self,
        face: Plane,
        merged: Gaussians,
        coarse: Gaussians,
        shots: Sequence[_Shot],
        pictures: Sequence[Picture],
    ) -> Steps[Difference]:
        """How far what the two blocks of a face show differs; each picture gets both."""
        shown: list[list[Seen]] = []
        for block in (face.below, face.above):
            cell = self._plan.cell(block)
            model = with_block(coarse, cell, retained(merged, cell, 0.0)).to(self._spec.device)
            shown.append([])
            for shot in shots:
                seen = self._see(model, shot.look, shot.exposure)
                shown[-1].append(seen.at(shot.strip.pixels))
                for picture in pictures:
                    if picture.look is shot.look:
                        picture.blocks.append(seen.color)
                yield from self._progress()
            del model
        difference = Difference()
        for shot, below, above in zip(shots, *shown, strict=True):
            difference.add(shot.strip, below, above)
        return difference

    def _report(
        self,
        face: Plane,
        looks: Sequence[Look],
        measured: _Measured,
        floors: Sequence[_Measured],
        difference: Difference,
    ) -> Seam:
        aabb, rows = self._plan.aabb, [look.row for look in looks if look.row is not None]
        merged = _with_floor(measured.merged, [floor.merged for floor in floors])
        coarse = _with_floor(measured.coarse, [floor.coarse for floor in floors])
        axes: tuple[Literal["x", "y", "z"], ...] = ("x", "y", "z")
        return Seam(
            blocks=(face.below, face.above),
            axis=axes[face.axis],
            at=aabb.center[face.axis] + (face.at - 0.5) * 4 * aabb.half[face.axis],
            cameras=tuple(self._scene.panoramas[row].name for row in rows),
            virtual=len(looks) - len(rows),
            seam=_ratio(merged.step_ratio, coarse.step_ratio),
            merged=merged,
            coarse=coarse,
            difference=schema.Difference(**difference.means),
        )


def _with_floor(errors: Errors, floors: Sequence[Errors]) -> schema.Ratios:
    floor = Errors()
    for part in floors:
        floor.join(part)
    (error, step), (error_floor, step_floor) = errors.means, floor.means
    return schema.Ratios(
        error=error,
        error_floor=error_floor,
        error_ratio=_ratio(error, error_floor),
        step=step,
        step_floor=step_floor,
        step_ratio=_ratio(step, step_floor),
    )


def _ratio(value: float | None, floor: float | None) -> float | None:
    return value / floor if value is not None and floor else None
