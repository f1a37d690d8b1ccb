"""RUN/exposure.json as a curve: how bright each training panorama is, in their order."""

from typing import Annotated

import numpy as np
from pydantic import BaseModel, Field, ValidationError

from panolog.orchestrator.runs.folder import RunFolder
from panolog.orchestrator.watch.views.queries import spread
from panolog.orchestrator.watch.views.summary import Text, ViewModel

_MOST = 20_000_000  # of the file: 50,000 panoramas and more
_POINTS = 600  # of the curve
_Gain = Annotated[float, Field(gt=0, lt=1e6)]


class _Panorama(BaseModel):
    name: Annotated[str, Field(max_length=4_096)]
    stops: Annotated[float, Field(gt=-100, lt=100)]
    gain: tuple[_Gain, _Gain, _Gain]  # RGB, in linear light


class _Content(BaseModel):
    panoramas: tuple[_Panorama, ...]


class ExposureCurve(ViewModel):
    """GET …/exposure: at most 600 of the panoramas in order, in stops over the mean; also of each channel."""

    name: tuple[Text, ...]
    stops: tuple[float, ...]
    red: tuple[float, ...]
    green: tuple[float, ...]
    blue: tuple[float, ...]


def exposure_curve(folder: RunFolder) -> ExposureCurve | None:
    """The curve; None if the file is of another format. Raises InputError where there is none."""
    try:
        found = _Content.model_validate_json(folder.read(folder.exposure, _MOST)).panoramas
    except ValidationError:
        return None
    if not found:
        return None
    chosen = spread(found, _POINTS)
    red, green, blue = np.log2([panorama.gain for panorama in chosen]).T.round(4).tolist()
    return ExposureCurve(
        name=tuple(panorama.name for panorama in chosen),
        stops=tuple(round(panorama.stops, 4) for panorama in chosen),
        red=tuple(red),
        green=tuple(green),
        blue=tuple(blue),
    )
