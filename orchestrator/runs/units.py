"""Numbers for people, and from them; means of metrics."""

import math
import re
from collections.abc import Iterable, Mapping
from statistics import fmean

from panolog.scene.errors import ConfigError

DURATION = "a duration such as 90m, 12h, 1h30m, 30d or 8w"  # what people are to write
_PART = re.compile(r"(\d{1,9}(?:\.\d{1,9})?)([wdhms])")
_SECONDS = {"w": 604_800.0, "d": 86_400.0, "h": 3600.0, "m": 60.0, "s": 1.0}


def gib(size: float) -> str:
    if 0 < size < 2**20:
        return f"{size / 2**10:.1f} KiB"
    return f"{size / 2**30:.1f} GiB" if size >= 2**30 / 10 else f"{size / 2**20:.0f} MiB"


def duration(seconds: float) -> str:
    """Seconds for people: 4:07 or 2:04:07."""
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{rest:02d}" if hours else f"{minutes}:{rest:02d}"


def counted(number: int, what: str) -> str:
    """A number of things for people: "1 block", "2,000 cameras"."""
    return f"{number:,} {what}{'' if number == 1 else 's'}"


def seconds_of(text: str) -> float | None:
    """Seconds of a duration that people write, such as "8w", "1d 2h" or "1.5h"; None if it is none."""
    packed = "".join(text.split())
    parts = _PART.findall(packed)
    if not parts or "".join(map("".join, parts)) != packed:
        return None
    return sum(float(number) * _SECONDS[unit] for number, unit in parts)


def positive(name: str, environment: Mapping[str, str], default: float, hint: str) -> float:
    """The number in a variable of the environment, or a default. Raises ConfigError with the hint."""
    text = environment.get(name, "") or str(default)
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not 0 < value < 1e6:
        raise ConfigError(f"{name}={text}: write {hint}")
    return value


def means(views: Iterable[Mapping[str, float | None]]) -> dict[str, float | None]:
    """The mean of each metric over the views that have it; None where none has."""
    values: dict[str, list[float]] = {}
    for metrics in views:
        for name, value in metrics.items():
            values.setdefault(name, []).extend([] if value is None else [value])
    return {name: fmean(numbers) if numbers else None for name, numbers in values.items()}
