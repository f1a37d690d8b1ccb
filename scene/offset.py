"""SCENE/offset.json: where the scene's coordinates are in the world that they came from.

    {"offset": [x, y, z]}
    {"offset": [x, y, z], "frame": "ENU", "origin": {"latitude": φ, "longitude": λ, "altitude": h}}

A scene's coordinates plus `offset` are the source's: those of the program that it was imported from, or
metres east, north and up of `origin` (WGS84; degrees, metres). Training computes in float32, so large numbers
are kept here and never in the coordinates. Without the file there is nothing to add.
"""

from pathlib import Path
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from panolog.scene.errors import SceneError
from panolog.scene.files import write_bytes

NAME = "offset.json"
_MAX_BYTES = 65_536
_Coordinate = Annotated[float, Field(gt=-1e12, lt=1e12)]


class _Strict(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, allow_inf_nan=False)


class Origin(_Strict):
    """A place on WGS84."""

    latitude: float = Field(ge=-90, le=90, description="degrees north")
    longitude: float = Field(ge=-180, le=180, description="degrees east")
    altitude: float = Field(
        gt=-1e6, lt=1e6, description="metres, as GPS gave it: receivers differ in from where"
    )


class Offset(_Strict):
    """What SCENE/offset.json says."""

    offset: tuple[_Coordinate, _Coordinate, _Coordinate] = Field(description="to be added, in scene units")
    frame: Literal["ENU"] | None = Field(
        default=None, description="ENU = metres east, north, up of the origin"
    )
    origin: Origin | None = None

    @model_validator(mode="after")
    def _together(self) -> "Offset":
        if (self.frame is None) != (self.origin is None):
            raise ValueError("frame and origin belong together; give both or neither")
        return self


def write_offset(scene: Path, offset: Offset) -> None:
    """Writes SCENE/offset.json, atomically. Raises OSError if it cannot be written."""
    write_bytes(scene / NAME, offset.model_dump_json(exclude_none=True).encode() + b"\n")


def read_offset(scene: Path) -> Offset | None:
    """What SCENE/offset.json says; None without the file.

    Raises:
        SceneError: the file is damaged; the message names it and the field.
        OSError: it cannot be read.
    """
    path = scene / NAME
    if not path.is_file():
        return None
    with path.open("rb") as file:
        data = file.read(_MAX_BYTES + 1)
    if len(data) > _MAX_BYTES:
        raise SceneError(f"{path}: more than {_MAX_BYTES} bytes, so it is no offset; import the scene again")
    try:
        return Offset.model_validate_json(data)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        field = ".".join(map(str, first["loc"]))
        reason = first["msg"].removeprefix("Value error, ")
        raise SceneError(f"{path}: {field}: {reason}" if field else f"{path}: {reason}") from error
