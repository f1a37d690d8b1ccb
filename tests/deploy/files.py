"""Where the files of deploy/ are, and the shell that is in them."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import yaml

ROOT = Path(__file__).resolve().parents[2]
DEPLOY = ROOT / "deploy"


def load(name: str) -> Any:
    """A YAML file of deploy/ with one document."""
    return yaml.safe_load((DEPLOY / name).read_text())


def load_all(name: str) -> list[Any]:
    """A YAML file of deploy/ with several."""
    return list(yaml.safe_load_all((DEPLOY / name).read_text()))


def commands(config: Any) -> Iterator[str]:
    """Every shell command of a Ray cluster's configuration."""
    for key, value in config.items():
        if key.endswith("_commands"):
            yield from value
