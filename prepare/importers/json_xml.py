"""JSON and XML that may be damaged or hostile: bounded in memory, and errors name the file and the field."""

import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element, ParseError

import numpy as np
from defusedxml import DefusedXmlException
from defusedxml.ElementTree import fromstring
from numpy.typing import NDArray

from panolog.scene.colmap import LARGEST
from panolog.scene.errors import SceneError

MEMORY = 900_000_000  # bytes that a parsed file may need
# Bytes of Python objects that each of these characters may bring.
_JSON_COST = {b"{": 240, b"[": 96, b",": 40, b":": 40, b'"': 26}
_XML_COST = {b"<": 320, b"=": 120}
_WIDE = 64  # bytes more for each quote where a text is not ASCII: Python then takes up to four a character


@dataclass(frozen=True)
class JsonNode:
    """A value in a JSON file and the way to it."""

    path: Path
    value: Any
    field: str = ""

    def error(self, what: str) -> SceneError:
        """The error of this field."""
        return SceneError(f"{self.where}: {what}")

    @property
    def where(self) -> str:
        """File and field, for messages."""
        return f"{self.path}: {self.field}" if self.field else str(self.path)

    def get(self, key: str) -> "JsonNode | None":
        """The value of a key; None if it is missing. Raises SceneError if this is no object."""
        if not isinstance(self.value, dict):
            raise self.error("an object {...} was expected")
        if key not in self.value:
            return None
        return JsonNode(self.path, self.value[key], f"{self.field}.{key}" if self.field else key)

    def __getitem__(self, key: str) -> "JsonNode":
        """The value of a key. Raises SceneError if it is missing, or this is no object."""
        found = self.get(key)
        if found is None:
            raise self.error(f"has no {key!r}")
        return found

    def items(self) -> Iterator[tuple[str, "JsonNode"]]:
        """The keys and values of an object. Raises SceneError if this is none."""
        if not isinstance(self.value, dict):
            raise self.error("an object {...} was expected")
        for key, value in self.value.items():
            yield key, JsonNode(self.path, value, f"{self.field}.{key[:60]}" if self.field else key[:60])

    def __iter__(self) -> Iterator["JsonNode"]:
        """The members of a list. Raises SceneError if this is none."""
        if not isinstance(self.value, list):
            raise self.error("a list [...] was expected")
        for index, value in enumerate(self.value):
            yield JsonNode(self.path, value, f"{self.field}[{index}]")

    def __len__(self) -> int:
        """Members of a list or object; 0 of anything else."""
        return len(self.value) if isinstance(self.value, (list, dict)) else 0

    def array(self, *shape: int) -> NDArray[np.float64]:
        """Finite numbers of that shape, nested lists; without a shape, one. Raises SceneError otherwise."""
        try:
            array = np.array(self.value, np.float64)
        except (ValueError, TypeError, OverflowError) as error:
            raise self.error(f"{_shape(shape)} numbers were expected") from error
        if array.shape != shape or not (np.abs(array) < LARGEST).all():
            raise self.error(f"{_shape(shape)} finite numbers were expected")
        return array

    def integer(self, limit: int = 2**63) -> int:
        """A whole number from 0 up to `limit`, exclusive. Raises SceneError if it is none."""
        if isinstance(self.value, bool) or not isinstance(self.value, int) or not 0 <= self.value < limit:
            raise self.error(f"a whole number from 0 to {limit - 1} was expected")
        return self.value

    def text(self) -> str:
        """A string, not empty. Raises SceneError if it is none."""
        if not isinstance(self.value, str) or not self.value:
            raise self.error("a text was expected")
        return self.value


def load_json(path: Path) -> JsonNode:
    """The content of a JSON file.

    Raises:
        SceneError: no such file, no JSON (NaN and Infinity are none), or too large to be parsed in `MEMORY`.
        OSError: it cannot be read.
    """
    data = _read(path, _JSON_COST)
    try:
        value = json.loads(data.decode("utf-8-sig"), parse_constant=_refuse)
    except (ValueError, RecursionError) as error:
        reason = "nested too deeply" if isinstance(error, RecursionError) else str(error)[:120]
        raise SceneError(f"{path}: is not JSON ({reason}); export it again") from error
    return JsonNode(path, value)


def load_xml(path: Path) -> Element:
    """The root of an XML file; entities and document types are refused.

    Raises:
        SceneError: no such file, no XML, or too large to be parsed in `MEMORY`.
        OSError: it cannot be read.
    """
    data = _read(path, _XML_COST)
    try:
        root: Element = fromstring(data, forbid_dtd=True)
    except (ParseError, DefusedXmlException, ValueError, LookupError) as error:
        raise SceneError(f"{path}: is not plain XML ({str(error)[:120]}); export it again") from error
    return root


def xml_numbers(path: Path, field: str, text: str | None, count: int) -> NDArray[np.float64]:
    """(count,) finite numbers between blanks. Raises SceneError if they are not."""
    words = (text or "").split(None, count)
    try:
        numbers = [float(word) for word in words]
    except ValueError:
        numbers = []
    if len(numbers) != count or not all(abs(number) < LARGEST for number in numbers):
        raise SceneError(f"{path}: {field}: {count} finite numbers were expected")
    return np.array(numbers)


def _read(path: Path, costs: dict[bytes, int]) -> bytes:
    """The file's bytes, if the objects that they describe fit."""
    if not path.is_file():
        raise SceneError(f"{path}: there is no such file")
    if path.stat().st_size < MEMORY // 3:
        data = path.read_bytes()
        if _estimate(data, costs) < MEMORY:
            return data
    raise SceneError(f"{path}: too large to be read safely; export it without its points, and those as a PLY")


def _estimate(data: bytes, costs: dict[bytes, int]) -> int:
    """An upper bound of the bytes that `data`, its text and the objects in it take."""
    marks = sum(data.count(mark) * cost for mark, cost in costs.items())
    return 2 * len(data) + marks if data.isascii() else 5 * len(data) + marks + _WIDE * data.count(b'"')


def _refuse(name: str) -> float:
    raise ValueError(f"{name} is not a number")


def _shape(shape: tuple[int, ...]) -> str:
    return " x ".join(map(str, shape or (1,)))
