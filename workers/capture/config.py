"""The settings of what is learnt about how panoramas were captured. Free of torch, as all settings."""

from typing import Literal

from pydantic import Field

from panolog.workers.settings import Group


class ExposureConfig(Group):
    """The exposure of each panorama, learnt in Stage I and kept by all later stages."""

    learn: bool | Literal["auto"] = Field(
        default="auto",
        description="whether each panorama has its own exposure; auto: if `scene check` sees differences",
    )
    offset: bool = Field(default=False, description="whether black levels are learnt too, not only gains")
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


class CaptureConfig(Group):
    """What Stage I learns about how its panoramas were captured."""

    exposure: ExposureConfig = ExposureConfig()
    movers: MoversConfig = MoversConfig()
