"""RUN/prepare/progress.json and RUN/prepare/STEP.json: how far the preparation is, and what its steps made.

What is read may be damaged or made to do harm: it is bounded, and what is not of the format counts as
missing.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, TypeVar

from pydantic import BaseModel, ConfigDict, Field, StringConstraints, ValidationError

from panolog.orchestrator.runs.folder import RunFolder, write_json
from panolog.orchestrator.runs.preparation.settings import MOST_BYTES, Step
from panolog.scene.errors import InputError

_LINES, _LINE = 100, 500  # that a result keeps, characters of each
_Count = Annotated[int, Field(ge=0, lt=2**53)]
_Words = Annotated[str, StringConstraints(max_length=200)]
_Note = TypeVar("_Note", bound="_Model")


class _Model(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class StepProgress(_Model):
    """What is done now; a `total` of 0 is not known."""

    step: Step
    what: _Words  # a part of the step: "features"
    done: _Count = 0
    total: _Count = 0
    time: float = 0.0  # seconds since the epoch; 0 = not known
    panoramas: _Count = 0  # of which features are found; 0 = not known yet

    def __str__(self) -> str:
        return f"{self.what} {self.done:,} of {self.total:,}" if self.total else self.what


class Counts(_Model):
    """What the reconstruction has kept and refused."""

    panoramas: _Count
    registered: _Count
    points: _Count
    weak_links: _Count
    contradictions: _Count

    @staticmethod
    def of(content: Any) -> "Counts":
        """What sfm.json, of this `content`, says of the reconstruction."""
        return Counts(
            panoramas=content["panoramas"],
            registered=content["registered"],
            points=content["points"],
            weak_links=len(content["weak_links"]),
            contradictions=len(content["contradictions"]),
        )


class StepResult(_Model):
    """A step that is done."""

    step: Step
    settings: dict[str, Any] = Field(description="what it was made with: `Settings.of`")
    seconds: float = Field(ge=0, description="of the driver that ended it")
    lines: tuple[Annotated[str, StringConstraints(max_length=_LINE)], ...] = Field(max_length=_LINES)
    counts: Counts | None = None  # of the reconstruction


def write_note(path: Path, note: StepProgress | StepResult) -> None:
    """Writes one of them. Raises OSError if that is impossible."""
    write_json(path, note.model_dump(mode="json"))


def shortened(lines: Sequence[str]) -> tuple[str, ...]:
    """What a result keeps of lines."""
    kept = [line if len(line) <= _LINE else f"{line[: _LINE - 1]}…" for line in lines[:_LINES]]
    if len(lines) > _LINES:
        kept[-1] = f"… and {len(lines) - _LINES + 1:,} more lines"
    return tuple(kept)


def read_progress(folder: RunFolder) -> StepProgress | None:
    """What is done now; None if that is not known."""
    return _read(folder, folder.preparation_progress, StepProgress)


def read_result(folder: RunFolder, step: Step) -> StepResult | None:
    """The result of a step; None if it is not done."""
    found = _read(folder, folder.step_result(step), StepResult)
    return found if found is not None and found.step is step else None


def _read(folder: RunFolder, path: Path, kind: type[_Note]) -> _Note | None:
    try:
        return kind.model_validate_json(folder.read(path, MOST_BYTES))
    except (InputError, ValidationError):
        return None
