"""RUN/prepare/settings.json: of what a run makes its scene, and how. Written before the first step begins."""

from collections.abc import Iterator
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field, field_validator

from panolog.orchestrator.runs.folder import RunFolder, write_json
from panolog.workers.tasks import StrEnum

NADIR = 10.0  # degrees around straight down: the end of a stick, and stitching; neighbours see it from aside
MOST_BYTES = 1_000_000  # of a file in RUN/prepare


class Step(StrEnum):
    """A step of the preparation, in order."""

    MASKS = "masks"
    SFM = "sfm"
    DEPTH = "depth"
    CHECK = "check"


LABELS = {
    Step.SFM: "finding poses and points",
    Step.MASKS: "masking",
    Step.DEPTH: "estimating depth",
    Step.CHECK: "checking the scene",
}


class Options(BaseModel):
    """What a user may set of the preparation; None where a default depends on the source."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    sfm: dict[str, Any] = Field(default={}, description="fields of `SfmSettings` that are not the default")
    nadir: float | None = Field(
        default=None, ge=0, le=90, description="degrees around straight down; 0 = none"
    )
    static: bool | None = Field(default=None, description="mask what is the same in all panoramas")
    mask_model: str | None = Field(default=None, description="ONNX network; its manifest is next to it")
    depth_model: str | None = Field(default=None, description="ONNX network; its manifest is next to it")

    @field_validator("sfm")
    @classmethod
    def _as_stored(cls, given: dict[str, Any]) -> dict[str, Any]:
        """Tuples become lists, as in the file, so that settings compare equal."""
        return {name: list(it) if isinstance(it, tuple) else it for name, it in given.items()}

    @property
    def given(self) -> bool:
        """Whether anything is set."""
        return self != Options()


class Settings(Options):
    """How the scene of a run is made."""

    format: Literal[1] = 1
    source: str  # folder or video
    others: tuple[str, ...] = ()  # besides it, as they were given
    video: bool  # or one of them at least
    panoramas: int  # in the folders, and frames in the videos by their headers
    width: int  # of each in pixels
    nadir: float = Field(ge=0, le=90, description="degrees around straight down; 0 = none")
    static: bool = Field(description="mask what is the same in all panoramas")

    @property
    def sources(self) -> tuple[str, ...]:
        """All that the scene is made of."""
        return (self.source, *self.others)

    def steps(self) -> tuple[Step, ...]:
        """The steps that there are, in order."""
        masks = bool(self.nadir or self.static or self.mask_model)
        wanted = {Step.MASKS: masks, Step.DEPTH: self.depth_model is not None}
        return tuple(step for step in Step if wanted.get(step, True))

    def of(self, step: Step) -> dict[str, Any]:
        """What the result of a step depends on, besides that of the steps before."""
        match step:
            case Step.SFM:
                return {"source": self.source, **({"others": self.others} if self.others else {}), **self.sfm}
            case Step.MASKS:
                network = {"model": self.mask_model} if self.mask_model else {}
                return {"nadir": self.nadir, "static": self.static, **network}
            case Step.DEPTH:
                return {"model": self.depth_model}
        return {}


def write_settings(folder: RunFolder, settings: Settings) -> None:
    """Writes the settings. Raises OSError if that is impossible."""
    folder.make(folder.preparation)
    write_json(folder.preparation_settings, settings.model_dump(mode="json"))


def read_settings(folder: RunFolder) -> Settings | None:
    """The settings of a run that makes its scene; None of one that was given a scene.

    Raises RunFolderError if they cannot be read or are of another format.
    """
    path = folder.preparation_settings
    if not path.exists():
        return None
    return folder.parsed(path, MOST_BYTES, Settings.model_validate_json, "start a new run")


def as_arguments(options: Options) -> Iterator[str]:
    """The options of `panolog run` that set these."""
    for name, value in options.sfm.items():
        match name, value:
            case "distance", [one, other, metres]:
                yield from ("--distance", str(one), str(other), str(metres))
            case "gps", False:
                yield "--no-gps"
            case "partial", True:
                yield "--partial"
            case _:
                yield from (f"--{name}", str(value))
    if options.nadir is not None:
        yield from ("--nadir", str(options.nadir))
    if options.static is not None:
        yield "--static" if options.static else "--no-static"
    for what, model in {"--mask-model": options.mask_model, "--depth-model": options.depth_model}.items():
        if model is not None:
            yield from (what, model)
