"""The settings of what is learnt about how panoramas were captured. Free of torch, as all settings."""

from typing import Literal

from pydantic import Field

from panolog.workers.settings import Group


class ExposureConfig(Group):
    """The exposure of each panorama, learnt in Stage I and kept by all later stages."""

    learn: bool | Literal["auto"] = Field(
        default=False,
        description="whether each panorama has its own exposure; auto: if `scene check` sees differences",
    )
    begin: float = Field(
        default=0.3,
        ge=0,
        le=1,
        description="fraction of the iterations before: holes of an early model would pass for darkness",
    )


class MoversConfig(Group):
    """What single panoramas show and those around them do not, such as passers-by."""

    weigh: bool = Field(
        default=False, description="whether it is looked for in Stage I, and left out of all losses"
    )
    factor: float = Field(
        default=1.5,
        ge=1,
        le=100,
        description="error of a mover over the highest error of the same place in the panoramas around;"
        " smaller finds more, also of what was only hard to learn",
    )


class PosesConfig(Group):
    """The poses of the training panoramas, refined in Stage I and kept by all later stages."""

    refine: bool | Literal["auto"] = Field(
        default=False,
        description="whether poses are refined: adjusted to the tracks before Stage I, if that halves the"
        " reprojections' errors, then moved in Stage I; auto: in Stage I only if they are still off by more"
        " than `poses.residual`",
    )
    residual: float = Field(
        default=1.0, gt=0, description="median error of reprojections, pixels, above which auto refines"
    )
    rate: float = Field(
        default=0.4, gt=0, description="the most that a step moves a view, pixels of the images"
    )
    begin: float = Field(default=0.2, ge=0, le=1, description="share of Stage I after which poses move")
    visits: int = Field(
        default=8,
        ge=0,
        description="nor do they move before each view was seen so often, but from half of Stage I on: before"
        " the scene has shape its errors move cameras",
    )
    decay: float = Field(default=0.6, ge=0, le=1, description="share of that time in which steps get shorter")
    most: float = Field(default=8.0, gt=0, description="a view may move by so many pixels, or five residuals")


class CaptureConfig(Group):
    """What Stage I learns about how its panoramas were captured."""

    exposure: ExposureConfig = ExposureConfig()
    movers: MoversConfig = MoversConfig()
    poses: PosesConfig = PosesConfig()
