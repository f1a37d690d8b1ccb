"""What metrics.json and seams.json say of a run, whatever they hold: the files may come from elsewhere."""

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import islice
from typing import Any

from panolog.orchestrator.runs.folder import RunFolder, part_of
from panolog.orchestrator.runs.units import means
from panolog.orchestrator.watch.views.comparison.schema import METRICS, MeasuredView
from panolog.workers.seams.schema import Seam, parse_seams

_MOST = 16_000_000  # of metrics.json: of 70,000 panoramas; hostile JSON may need 20 times the memory
_MOST_SEAMS = 200_000_000  # of seams.json
_VIEWS = 70_000
MEASURED_ANEW = "`panolog eval` measures it anew"

Values = Mapping[str, float | None]  # metrics by name


@dataclass(frozen=True)
class Measured:
    """The metrics of a run: of each held-out panorama, and how they were measured."""

    head: MeasuredView
    views: Mapping[str, Values]
    mean: Values

    @property
    def conditions(self) -> tuple[int | None, float]:
        """What must be the same for values to be comparable: width and crop."""
        return self.head.width, self.head.crop_bottom or 0.0


def read_measured(folder: RunFolder) -> Measured | None:
    """The content of metrics.json, if there is one; a value that is no finite number counts as not measured.

    Raises InputError if it is no JSON object, or cannot be read.
    """
    path = folder.metrics
    if not path.exists():
        return None
    content = folder.parsed(path, _MOST, _object, MEASURED_ANEW)
    views = {name: _values(values) for name, values in islice(part_of(content, "views").items(), _VIEWS)}
    head = MeasuredView(
        width=whole(content.get("width")),
        crop_bottom=_number(content.get("crop_bottom")),
        detail=_number(content.get("detail")),
        panoramas=len(views),
        left_out=len(part_of(content, "left_out")),
        gaussians=whole(content.get("gaussians")),
    )
    mean = means(views.values()) if views else _values(content.get("mean"))
    return Measured(head, views, mean)


def read_seams(folder: RunFolder) -> tuple[Seam, ...]:
    """The faces in seams.json, the worst first; none if there is no such file. Raises as `read_measured`."""
    path = folder.seams
    return folder.parsed(path, _MOST_SEAMS, parse_seams, MEASURED_ANEW) if path.exists() else ()


def _object(content: bytes) -> dict[str, Any]:
    """A JSON object. Raises ValueError if the content is none."""
    found = json.loads(content)
    if not isinstance(found, dict):
        raise ValueError("no object")
    return found


def finite(value: float | None) -> float | None:
    """The value, None for what is not a finite number: JSON has none of these."""
    return value if value is not None and math.isfinite(value) else None


def _values(given: Any) -> dict[str, float | None]:
    """The metrics in a JSON object."""
    known = given if isinstance(given, dict) else {}
    return {name: _number(known.get(name)) for name in METRICS}


def _number(value: Any) -> float | None:
    """A finite number; None for all else."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        return None
    try:
        number = float(value)
    except OverflowError:
        return None
    return finite(number)


def whole(value: Any) -> int | None:
    """A whole number that is not negative; None for all else."""
    number = _number(value)
    return int(number) if number is not None and number >= 0 and number == int(number) else None
