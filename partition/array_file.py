"""Arrays in a file without a name: what is too large for memory, written in pieces and read by mapping."""

import mmap
import pickle
import tempfile
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from io import FileIO
from pathlib import Path
from typing import Any, Generic, TypeVar

import numpy as np
from numpy.typing import DTypeLike, NDArray

from panolog.scene.files import read_at, write_all

T = TypeVar("T")

_ALIGNMENT = 64  # bytes between beginnings of arrays, a multiple of every element


@dataclass(frozen=True)
class Place:
    """Where an array is in an `ArrayFile`."""

    offset: int  # bytes
    shape: tuple[int, ...]
    dtype: np.dtype[Any]

    @property
    def nbytes(self) -> int:
        """Bytes of the array."""
        return int(np.prod(self.shape)) * self.dtype.itemsize


@dataclass(frozen=True)
class Kept(Generic[T]):
    """A value whose arrays are in an `ArrayFile`."""

    value: bytes  # all else, pickled
    arrays: tuple[Place, ...]


class ArrayFile:
    """Arrays on a disk for as long as this process uses them; the system then removes them.

    What is read is mapped: memory holds the parts in use, as long as there is room for them.
    """

    def __init__(self, folder: Path) -> None:
        """Empty. Args: folder, on the disk to use. Raises OSError if it takes no file."""
        self._file: FileIO = tempfile.TemporaryFile(dir=folder, buffering=0)  # noqa: SIM115  # as long as maps
        self._size = 0
        self._map: mmap.mmap | None = None

    def reserve(self, shape: tuple[int, ...], dtype: DTypeLike) -> Place:
        """Room for an array, zeros until it is written."""
        place = Place(self._size, shape, np.dtype(dtype))
        self._size += -(-place.nbytes // _ALIGNMENT) * _ALIGNMENT
        return place

    def write(self, place: Place, row: int, rows: NDArray[Any]) -> None:
        """Rows of a reserved array, from `row` on. Raises OSError if the disk is full."""
        self._file.seek(place.offset + row * self._row(place))
        write_all(self._file, _bytes(np.ascontiguousarray(rows, place.dtype)))

    def rows(self, place: Place, start: int, stop: int) -> NDArray[Any]:
        """A copy of some rows of an array. Raises OSError if they cannot be read."""
        found = np.empty((stop - start, *place.shape[1:]), place.dtype)
        self._file.truncate(self._size)
        read_at(self._file, place.offset + start * self._row(place), _bytes(found))
        return found

    def read(self, place: Place) -> NDArray[Any]:
        """An array, read-only and mapped. It stays valid as long as it is used."""
        if not place.nbytes:
            return np.zeros(place.shape, place.dtype)
        if self._map is None or len(self._map) < self._size:
            self._file.truncate(self._size)
            self._map = mmap.mmap(self._file.fileno(), self._size, access=mmap.ACCESS_READ)
        count = int(np.prod(place.shape))
        return np.frombuffer(self._map, place.dtype, count, place.offset).reshape(place.shape)

    @staticmethod
    def _row(place: Place) -> int:
        """Bytes of a row."""
        return place.nbytes // max(1, place.shape[0])

    def keep(self, value: T) -> Kept[T]:
        """Any value that can be pickled; its numpy arrays go into the file. Raises OSError if it is full."""
        places: list[Place] = []

        def take(buffer: pickle.PickleBuffer) -> None:
            content = np.frombuffer(buffer.raw(), np.uint8)
            places.append(self.reserve(content.shape, content.dtype))
            self.write(places[-1], 0, content)

        head = pickle.dumps(value, protocol=5, buffer_callback=take)
        return Kept(head, tuple(places))

    def load(self, kept: Kept[T]) -> T:
        """A value of `keep`, whose arrays are read-only maps of the file."""
        value: T = pickle.loads(kept.value, buffers=[self.read(place) for place in kept.arrays])
        return value


def _bytes(array: NDArray[Any]) -> memoryview:
    return array.reshape(-1).view(np.uint8).data


def sorted_runs(
    folder: Path, pieces: Iterable[Mapping[str, NDArray[Any]]], labels: NDArray[np.int64], count: int
) -> Iterator[dict[str, NDArray[Any]]]:
    """The rows of a table that does not fit into memory, by label: those of 0, then those of 1, and so on.

    Rows of a label keep their order. Memory holds one piece, and then one label's rows.

    Args: folder, on the disk to use; pieces of the table by column, in order, at least one, with at least as
    many rows as labels: what follows is left out; labels (N,) of its rows; count of labels.
    Raises OSError if the disk is full.
    """
    file, sizes = ArrayFile(folder), np.bincount(labels, minlength=count)
    ends = np.cumsum(sizes)
    places: dict[str, Place] = {}
    filled, start = ends - sizes, 0
    for piece in pieces:
        for name, column in piece.items():
            if name not in places:
                places[name] = file.reserve((len(labels), *column.shape[1:]), column.dtype)
        rows = labels[start : start + len(next(iter(piece.values())))]
        start += len(rows)
        order = np.argsort(rows, kind="stable")
        found, begins = np.unique(rows[order], return_index=True)
        for label, at in zip(found.tolist(), np.split(order, begins[1:]), strict=True):
            for name, place in places.items():
                file.write(place, filled[label], piece[name][at])
            filled[label] += len(at)
        if start == len(labels):
            break
    for begin, end in zip((ends - sizes).tolist(), ends.tolist(), strict=True):
        yield {name: file.rows(place, begin, end) for name, place in places.items()}
