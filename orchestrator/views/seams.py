"""seams.json as views read it: what was measured at the faces between blocks."""

from collections.abc import Mapping
from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from panolog.scene.errors import InputError

Measured = Annotated[float, Field(ge=0, allow_inf_nan=False)] | None

# From which seam on a face stands out, with the colour that it then has on maps, in light and dark.
GRADES = {
    "hardly": (0.0, "#2a9d5c"),  # hardly more than without blocks
    "some": (1.5, "#d98a1f"),
    "clear": (3.0, "#d6453d"),
}


class _Part(BaseModel):
    model_config = ConfigDict(frozen=True)


class Ratios(_Part):
    """Error and step of one model at a face and within the blocks, and the ratio of both."""

    error: Measured
    error_floor: Measured
    error_ratio: Measured
    step: Measured
    step_floor: Measured
    step_ratio: Measured


class Difference(_Part):
    """How far what the two blocks show differs."""

    color: Measured
    psnr: Measured
    depth: Measured
    opacity: Measured


class SeamView(_Part):
    """A face between two blocks, see `workers.seams`."""

    blocks: tuple[int, int]
    axis: str = Field(pattern="^[xyz]$")
    cameras: tuple[str, ...]
    virtual: int
    seam: Measured
    merged: Ratios
    coarse: Ratios
    difference: Difference

    @property
    def grade(self) -> str | None:
        """How clearly it stands out: a key of GRADES, None if that is not known."""
        return None if self.seam is None else grade_of(self.seam)


class _SeamsFile(_Part):
    faces: tuple[SeamView, ...]


def grade_of(seam: float) -> str:
    """The last grade that a seam reaches."""
    return next(name for name, (least, _) in reversed(GRADES.items()) if seam >= least)


def parse_seams(content: bytes) -> tuple[SeamView, ...]:
    """The faces of a seams.json, the worst first. Raises InputError if it is none."""
    try:
        faces = _SeamsFile.model_validate_json(content).faces
    except ValidationError as error:
        raise InputError(f"seams.json: {error.error_count()} values are wrong; measure it again") from error
    return tuple(sorted(faces, key=lambda face: -(face.seam or 0.0)))


def by_blocks(faces: tuple[SeamView, ...]) -> Mapping[tuple[int, int], float]:
    """The seams of the faces that have one, by their blocks."""
    return {face.blocks: face.seam for face in faces if face.seam is not None}
