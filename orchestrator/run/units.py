"""Numbers for people, and from them."""

import math
from collections.abc import Mapping

from panolog.scene.errors import ConfigError


def gib(size: float) -> str:
    """Bytes for people."""
    return f"{size / 2**30:.1f} GiB" if size >= 2**30 / 10 else f"{size / 2**20:.0f} MiB"


def duration(seconds: float) -> str:
    """Seconds for people: 4:07 or 2:04:07."""
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{rest:02d}" if hours else f"{minutes}:{rest:02d}"


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
