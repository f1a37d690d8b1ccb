"""The price list of a user, TOML: what a machine costs per hour, by how it is known (docs/money.md).

The first entry that matches counts. Storage and transfer are not counted.
"""

import json
import os
import re
import sys
from collections.abc import Callable, Mapping
from dataclasses import replace
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from panolog.orchestrator.runs.machines.nodes import Node
from panolog.orchestrator.runs.money.records import BudgetSet, NodeReserved
from panolog.orchestrator.runs.units import gib
from panolog.scene.errors import ConfigError, in_one_line, wrong_value

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

_MOST_BYTES = 2**18  # of a file
_SPOT = {"spot", "preemptible"}  # values of the label by which Ray and providers say it
_MARKET = "ray.io/market-type"
_TABLE = re.compile(r"^\s*\[\[\s*machine\s*\]\]")


class MachinePrice(BaseModel):
    """One entry: all patterns that are given must match (`fnmatch`, in either case)."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    name: str = Field(min_length=1, max_length=100)
    price: float = Field(ge=0, le=1e9)
    spot: float | None = Field(default=None, ge=0, le=1e9)
    instance: str | None = Field(default=None, max_length=200)
    host: str | None = Field(default=None, max_length=200)
    gpu: str | None = Field(default=None, max_length=200)
    label: str | None = Field(default=None, max_length=200, pattern="=")

    def matches(self, node: Node) -> bool:
        """Whether this is the entry of a machine."""
        patterns = (self.instance, self.host, self.gpu, self.label)
        if not any(patterns):
            return _like(self.name, [node.instance])
        known = ([node.instance], [node.host], [gpu.name for gpu in node.gpus])
        labels = [f"{key}={value}" for key, value in node.labels]
        pairs = zip(patterns, (*known, labels), strict=True)
        return all(_like(pattern, values) for pattern, values in pairs if pattern is not None)


class PriceList(BaseModel):
    """The content of a price file."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    currency: str = Field(min_length=1, max_length=8, pattern=r"^[^\s\d]+$")
    machine: tuple[MachinePrice, ...] = Field(min_length=1, max_length=1000)

    def of(self, node: Node) -> MachinePrice | None:
        """The entry of a machine; None if there is none."""
        return next((entry for entry in self.machine if entry.matches(node)), None)

    def reserved(self, node: Node) -> NodeReserved:
        """The record of a machine: one without an entry costs as much as the dearest, so that limits hold."""
        entry = self.of(node)
        if entry is None:
            dearest = max(self.machine, key=lambda entry: entry.price)
            kind = f"{kind_of(node)}, not in the price list: priced as {dearest.name}"
            return NodeReserved(node.id, node.host, kind, dearest.price)
        spot = any(key == _MARKET and value.casefold() in _SPOT for key, value in node.labels)
        if entry.spot is not None and spot:
            return NodeReserved(node.id, node.host, f"{entry.name} spot", entry.spot)
        return NodeReserved(node.id, node.host, entry.name, entry.price)


def kind_of(node: Node) -> str:
    """What a machine is called without a price list: its instance type, its GPUs or its cores."""
    if node.instance:
        return node.instance
    if node.gpus:
        return f"{len(node.gpus)} x {node.gpus[0].name}"
    return f"{node.cpus} cores, {gib(node.memory)}"


def reserved(node: Node, prices: PriceList | None) -> NodeReserved:
    """The record of a machine, with the price of its share if there are prices."""
    if prices is None:
        return NodeReserved(node.id, node.host, kind_of(node), None)
    whole = prices.reserved(node)
    if node.share == 1 or whole.price is None:
        return whole
    return replace(whole, kind=f"{100 * node.share:.0f} % of {whole.kind}", price=node.share * whole.price)


def price_by(prices: PriceList | None) -> Callable[[Node], float | None]:
    """What a machine costs per hour by a list; None if that is not known."""
    return lambda node: reserved(node, prices).price


def default_path() -> Path:
    """Where a user's own price list is: by the XDG base directory specification."""
    home = os.environ.get("XDG_CONFIG_HOME", "")
    folder = Path(home) if Path(home).is_absolute() else Path.home() / ".config"
    return folder / "panolog" / "prices.toml"


def find_prices(given: str | None) -> PriceList | None:
    """The prices of an option `--prices`, else those of the user; None if there are none.

    Args: given, a file, or a list as JSON, as one command gives it to another.
    Raises ConfigError if the list is wrong, and names the line.
    """
    if given is not None:
        return parse_json(given) if given.lstrip().startswith("{") else read_prices(Path(given))
    path = default_path()
    return read_prices(path) if path.is_file() else None


def read_prices(path: Path) -> PriceList:
    """The content of a price file. Raises ConfigError that names the line."""
    try:
        with path.open("rb") as file:
            content = file.read(_MOST_BYTES + 1)
        text = content.decode()
        if len(content) > _MOST_BYTES:
            raise ConfigError(f"{path}: has more than {_MOST_BYTES // 1024} KiB; it is no price list")
        tree = tomllib.loads(text)
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise ConfigError(f"{path}: is not UTF-8 text") from error
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(f"{path}: is not TOML: {in_one_line(error)}") from error
    return _checked(tree, str(path), text)


def parse_json(text: str) -> PriceList:
    """Reads a price list from JSON. Raises ConfigError."""
    try:
        tree = json.loads(text[:_MOST_BYTES])
    except (ValueError, RecursionError) as error:
        raise ConfigError(f"--prices: is not JSON: {error}") from error
    return _checked(tree, "--prices", "")


def prices_of(budget: BudgetSet | None) -> PriceList | None:
    """The prices of a run; None if it has none. Raises ConfigError if they are of another format."""
    return _checked(budget.prices, "the run's prices", "") if budget and budget.prices else None


def _checked(tree: Mapping[str, Any], where: str, text: str) -> PriceList:
    try:
        return PriceList.model_validate(tree)
    except ValidationError as error:
        first = error.errors()[0]
        line = _line_of(text, first["loc"])
        key = ".".join(str(part + 1) if isinstance(part, int) else str(part) for part in first["loc"])
        place = f"{where}, line {line}" if line else where
        if first["type"] == "extra_forbidden":
            raise ConfigError(f"{place}: {key} is no key of a price list; see docs/money.md") from error
        if first["type"] == "missing":
            raise ConfigError(f"{place}: {key} is missing; see docs/money.md") from error
        raise ConfigError(f"{place}: {key} = {first['input']!r:.80}: {wrong_value(first)}") from error


def _line_of(text: str, place: tuple[int | str, ...]) -> int:
    """The line of a key, or of its table if that lacks it; 0 without a text. Args: place, as of pydantic."""
    lines = text.splitlines()
    tables = [number for number, line in enumerate(lines, 1) if _TABLE.match(line)]
    first, last = 1, len(lines)
    if len(place) > 1 and isinstance(place[1], int) and place[1] < len(tables):
        first = tables[place[1]]
        last = tables[place[1] + 1] - 1 if place[1] + 1 < len(tables) else len(lines)
    key = re.compile(rf"^\s*\"?{re.escape(str(place[-1]))}\"?\s*=")
    found = (number for number in range(first, last + 1) if key.match(lines[number - 1]))
    return next(found, first if lines else 0)


def _like(pattern: str, values: list[str]) -> bool:
    return any(fnmatchcase(value.casefold(), pattern.casefold()) for value in values if value)
