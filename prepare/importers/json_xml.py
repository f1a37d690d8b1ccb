"""JSON and XML that may be damaged or hostile: bounded in memory, and errors name the file and the field."""

import codecs
import json
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO
from xml.etree.ElementTree import Element, ParseError

import numpy as np
from defusedxml import DefusedXmlException
from defusedxml.ElementTree import fromstring
from numpy.typing import NDArray

from panolog.scene.colmap import LARGEST
from panolog.scene.errors import SceneError

MEMORY = 900_000_000  # bytes that a parsed file may need, where the caller does not say
# Bytes of Python objects that each of these characters may bring.
_JSON_COST = {b"{": 240, b"[": 96, b",": 40, b":": 40, b'"': 26}
_XML_COST = {b"<": 320, b"=": 120}
_CHUNK = 2**20  # bytes that are read at once of a file that is read in pieces
_AHEAD = 2**16  # characters of it that are parsed at once, at first: most members of a list are shorter
_LITERAL = 16  # characters: at most so many of a name such as -Infinity or of an escape have been cut off
_BLANKS = re.compile(r"[ \t\r\n]*")
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

    def integer(self, limit: int) -> int:
        """A whole number from 0 up to `limit`, exclusive. Raises SceneError if it is none."""
        if isinstance(self.value, bool) or not isinstance(self.value, int) or not 0 <= self.value < limit:
            raise self.error(f"a whole number from 0 to {limit - 1} was expected")
        return self.value

    def text(self) -> str:
        """A string, not empty. Raises SceneError if it is none."""
        if not isinstance(self.value, str) or not self.value:
            raise self.error("a text was expected")
        return self.value


def load_json(path: Path, memory: int = MEMORY) -> JsonNode:
    """The content of a JSON file.

    Raises SceneError: no such file, no JSON (NaN and Infinity are none), or too large to be parsed in so many
    bytes; OSError: it cannot be read.
    """
    data = _read(path, _JSON_COST, memory)
    try:
        value = json.loads(data.decode("utf-8-sig"), parse_constant=_refuse)
    except (ValueError, RecursionError) as error:
        raise _no_json(path, error) from error
    return JsonNode(path, value)


def load_json_in_pieces(
    path: Path, key: str, each: Callable[[JsonNode], None], memory: int = MEMORY
) -> JsonNode:
    """The content of a JSON file with an object, without the list `key` of it, which may be of any length.

    Args:
        key: of the list in the object.
        each: gets the members of the list, one after the other. None is kept.
        memory: bytes that the rest of the object, or a member of the list, may need.

    Raises SceneError: no such file, no JSON object, or too large; whatever `each` raises; OSError: it cannot
    be read.
    """
    if not path.is_file():
        raise SceneError(f"{path}: there is no such file")
    with path.open("rb") as file:
        text = _JsonText(path, file, memory)
        rest: dict[str, Any] = {}
        if text.next() != "{":
            raise JsonNode(path, None).error("an object {...} was expected")
        for name in text.names():
            if name == key and text.next() == "[":
                for index, value in enumerate(text.members()):
                    each(JsonNode(path, value, f"{key}[{index}]"))
            else:
                rest[name] = text.value(keep=True)
        text.end()
    return JsonNode(path, rest)


class _JsonText:
    """JSON that is read from a file in pieces, each of which Python's parser gets as soon as it is whole."""

    def __init__(self, path: Path, file: BinaryIO, memory: int) -> None:
        self._path, self._file, self._left = path, file, memory
        self._decoder = codecs.getincrementaldecoder("utf-8-sig")()
        self._parser = json.JSONDecoder(parse_constant=_refuse)
        self._text, self._at, self._ended = "", 0, False

    def next(self) -> str:
        """The next character that is no blank; "" at the end."""
        while True:
            found = _BLANKS.match(self._text, self._at)
            self._at = found.end() if found else self._at
            if self._at < len(self._text) or not self._more():
                return self._text[self._at : self._at + 1]

    def names(self) -> Iterator[str]:
        """The keys of the object that begins here; the value of each has to be read before the next."""
        for _ in self._parts("{", "}"):
            name = self.value() if self.next() == '"' else None
            if not isinstance(name, str):
                raise self._error("a key was expected")
            self._take(":")
            yield name

    def members(self) -> Iterator[Any]:
        """The members of the list that begins here."""
        for _ in self._parts("[", "]"):
            yield self.value()

    def value(self, *, keep: bool = False) -> Any:
        """The value that begins here. If it is kept, what it needs is no longer there for others."""
        self.next()
        wanted = _AHEAD
        while True:
            while (short := wanted - (len(self._text) - self._at)) > 0 and self._more(short):
                pass
            if wanted > _AHEAD and self._estimate(len(self._text)) > self._left:
                raise _too_large(self._path)
            try:
                value, end = self._parser.raw_decode(self._text, self._at)
            except json.JSONDecodeError as error:
                if self._ended or self._is_wrong(error):  # else it may be whole with more of it
                    raise _no_json(self._path, ValueError(error.msg)) from error
            except (ValueError, RecursionError) as error:
                raise _no_json(self._path, error) from error
            else:
                if end <= len(self._text) - _LITERAL or self._ended:  # else a number may continue
                    break
            wanted = max(2 * (len(self._text) - self._at), 2 * wanted)
        if keep:
            self._left -= self._estimate(end)
            if self._left < 0:
                raise _too_large(self._path)
        self._at = end
        return value

    def end(self) -> None:
        """Checks that nothing follows."""
        if self.next():
            raise self._error("something follows its end")

    def _parts(self, begin: str, end: str) -> Iterator[None]:
        """Once for each part of what begins here, with commas in between."""
        self._take(begin)
        if self.next() == end:
            self._at += 1
            return
        while True:
            yield
            mark = self.next()
            self._at += 1
            if mark == end:
                return
            if mark != ",":
                raise self._error(f"',' or '{end}' was expected")

    def _take(self, mark: str) -> None:
        if self.next() != mark:
            raise self._error(f"'{mark}' was expected")
        self._at += 1

    def _is_wrong(self, error: json.JSONDecodeError) -> bool:
        """Whether more text would not help: a value that is cut off is wrong at the end of the text."""
        return error.pos < len(self._text) - _LITERAL and not error.msg.startswith("Unterminated string")

    def _more(self, least: int = 0) -> bool:
        """Reads a piece; False at the end of the file."""
        if self._ended:
            return False
        data = self._file.read(max(_CHUNK, least))
        self._ended = not data
        try:
            piece = self._decoder.decode(data, final=self._ended)
        except UnicodeDecodeError as error:
            raise _no_json(self._path, error) from error
        self._text, self._at = self._text[self._at :] + piece, 0
        return True

    def _estimate(self, end: int) -> int:
        """An upper bound of the bytes that the text up to `end` and the objects in it take."""
        marks = ((mark.decode(), cost) for mark, cost in _JSON_COST.items())
        found = sum(self._text.count(mark, self._at, end) * cost for mark, cost in marks)
        wide = 0 if self._text.isascii() else _WIDE * self._text.count('"', self._at, end)
        return found + wide + 5 * (end - self._at)

    def _error(self, what: str) -> SceneError:
        return _no_json(self._path, ValueError(what))


def _no_json(path: Path, error: Exception) -> SceneError:
    reason = "nested too deeply" if isinstance(error, RecursionError) else str(error)[:120]
    return SceneError(f"{path}: is not JSON ({reason}); export it again")


def load_xml(path: Path, memory: int = MEMORY) -> Element:
    """The root of an XML file; entities and document types are refused.

    Raises SceneError: no such file, no XML, or too large to be parsed in so many bytes; OSError: it cannot be
    read.
    """
    data = _read(path, _XML_COST, memory)
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


def _read(path: Path, costs: dict[bytes, int], memory: int) -> bytes:
    """The file's bytes, if the objects that they describe fit."""
    if not path.is_file():
        raise SceneError(f"{path}: there is no such file")
    if path.stat().st_size < memory // 3:
        data = path.read_bytes()
        if _estimate(data, costs) < memory:
            return data
    raise _too_large(path)


def _too_large(path: Path) -> SceneError:
    return SceneError(
        f"{path}: too large to be read with the memory that is free; free some, or export it without its "
        "points, and those as a PLY"
    )


def _estimate(data: bytes, costs: dict[bytes, int]) -> int:
    """An upper bound of the bytes that `data`, its text and the objects in it take."""
    marks = sum(data.count(mark) * cost for mark, cost in costs.items())
    return 2 * len(data) + marks if data.isascii() else 5 * len(data) + marks + _WIDE * data.count(b'"')


def _refuse(name: str) -> float:
    raise ValueError(f"{name} is not a number")


def _shape(shape: tuple[int, ...]) -> str:
    return " x ".join(map(str, shape or (1,)))
