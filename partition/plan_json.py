"""The schema of plan.json, version 2. Version 1 also had all gradient scores, which are in scores.npz."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from panolog.partition.cells import Cut, Layout
from panolog.scene.errors import InputError, wrong_value

Triple = tuple[float, float, float]
Reason = Literal["geometry", "gradient", "both"]


class _Strict(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class Box(_Strict):
    """An axis-aligned box; half-open where it is a cell."""

    lower: Triple
    upper: Triple


class Block(_Strict):
    """One block."""

    block: int  # in a grid (z·B_y + y)·B_x + x
    contracted: Box  # the half-open cell [l_b, u_b) in contracted coordinates
    gaussians: int  # scene Gaussians of Stage I inside
    cameras: list[int]  # rows of the panoramas that train it


class PlanCamera(_Strict):
    """One training panorama."""

    row: int
    name: str
    center: Triple  # world units
    block: int  # that the camera is in
    scores: Any = Field(default=None, exclude=True)  # of version 1; not used
    assigned: dict[int, Reason]  # by block


class PlanFile(_Strict):
    """The content of plan.json. Lengths are in world units."""

    version: Literal[1, 2] = 2
    rho_tri: float
    aspect: float = 0.5  # before there was such a setting, it was this
    tau_grad: float
    min_cameras: int = 1  # before there was such a setting, one was enough
    min_share: float = 0.0  # and any Gaussians were
    grid: tuple[int, int, int] | None  # (B_x, B_y, B_z); None where blocks are balanced
    cells: Layout = "cube"  # what the cells along an axis of a grid are equal parts of
    cuts: tuple[Cut, ...] = ()  # of balanced blocks, as `cells.Cuts`
    baseline: float  # b̂ of eq. 8
    aabb: Box  # eq. 9
    blocks: list[Block]
    cameras: list[PlanCamera]


def reason(*, geometric: bool, gradient: bool) -> Reason:
    """Why a camera was assigned to a block, by at least one of the two criteria of eq. 11."""
    if geometric and gradient:
        return "both"
    return "geometry" if geometric else "gradient"


def parse(data: object) -> PlanFile:
    """The checked content of plan.json. Raises InputError with the first value that is wrong."""
    try:
        return PlanFile.model_validate(data)
    except ValidationError as error:
        first = error.errors()[0]
        place = ".".join(map(str, first["loc"])) or "the top level"
        raise InputError(
            f"plan.json is not a plan of version 2: {place}: {wrong_value(first)}; make the plan again"
        ) from None


@contextmanager
def contradictions() -> Iterator[None]:
    """Turns the ValueErrors of the partition into an InputError about plan.json."""
    try:
        yield
    except ValueError as error:
        text = str(error).splitlines()[0]
        raise InputError(f"plan.json contradicts itself: {text}; make the plan again") from error
