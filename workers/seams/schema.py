"""The schema of seams.json: what was measured at the faces between blocks. Imports no torch."""

from collections.abc import Iterable, Mapping
from statistics import fmean
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from panolog.scene.errors import InputError

Measured = Annotated[float, Field(ge=0, allow_inf_nan=False)] | None


class _Part(BaseModel):
    model_config = ConfigDict(frozen=True, allow_inf_nan=False)


class Ratios(_Part):
    """Error and step of one model at a face, those within the blocks (floor), and the ratios of both."""

    error: Measured  # root mean squared, of colours in [0, 1]
    error_floor: Measured
    error_ratio: Measured
    step: Measured  # mean, of colours in [0, 1]
    step_floor: Measured
    step_ratio: Measured


class Difference(_Part):
    """How far what the two blocks show differs."""

    color: Measured  # mean absolute, of colours in [0, 1]
    psnr: Measured  # dB
    depth: Measured  # mean, relative to the distance, at most 1
    opacity: Measured  # mean, of accumulated opacities


class Seam(_Part):
    """A face between two blocks, see `workers.seams.measurement`."""

    blocks: tuple[int, int]  # at lower and at higher coordinates
    axis: Literal["x", "y", "z"]  # that it is perpendicular to
    at: float  # its coordinate on that axis, world units
    cameras: tuple[str, ...]  # names of panoramas
    virtual: int  # cameras
    seam: Measured  # step ratio of the merged model over that of Stage I
    merged: Ratios
    coarse: Ratios
    difference: Difference


class SeamsFile(_Part):
    """The content of seams.json."""

    mean: Measured  # of `seam` of the faces that have one
    worst: Measured
    faces: tuple[Seam, ...]

    @staticmethod
    def of(faces: Iterable[Seam]) -> "SeamsFile":
        """The file of some faces."""
        found = tuple(faces)
        seams = [face.seam for face in found if face.seam is not None]
        return SeamsFile(mean=fmean(seams) if seams else None, worst=max(seams, default=None), faces=found)


def parse_seams(content: bytes) -> tuple[Seam, ...]:
    """The faces of a seams.json, the worst first. Raises InputError if it is none."""
    try:
        faces = SeamsFile.model_validate_json(content).faces
    except ValidationError as error:
        raise InputError(f"seams.json: {error.error_count()} values are wrong; measure it again") from error
    return tuple(sorted(faces, key=lambda face: -(face.seam or 0.0)))


def by_blocks(faces: Iterable[Seam]) -> Mapping[tuple[int, int], float]:
    """The seams of the faces that have one, by their blocks."""
    return {face.blocks: face.seam for face in faces if face.seam is not None}
