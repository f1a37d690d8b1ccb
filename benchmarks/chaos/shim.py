"""Faults of files and of the clock for chosen processes: `shim.c`, compiled, and its control file."""

import mmap
import struct
import subprocess
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from panolog.scene.errors import RunError

READ, WRITE = 1, 2  # sorts of calls
_SOURCE = Path(__file__).with_name("shim.c")
_HEADER = struct.Struct("=qq")  # clock offset in ns, whether a rule is on
_RULE = struct.Struct("=iiii1008s")  # calls, errno, delay in us, calls left, path
_RULES = 4


def build(folder: Path) -> Path:
    """Compiles the library into a folder. Raises RunError if there is no C compiler."""
    library = folder / "shim.so"
    command = ["cc", "-std=gnu11", "-O2", "-shared", "-fPIC", str(_SOURCE), "-o", str(library), "-ldl"]
    try:
        subprocess.run(command, check=True, capture_output=True, text=True)
    except (OSError, subprocess.CalledProcessError) as error:
        raise RunError(f"chaos needs a C compiler (cc): {getattr(error, 'stderr', None) or error}") from error
    return library


@dataclass(frozen=True)
class Rule:
    """A fault of files."""

    folder: Path  # of the files; need not exist
    calls: int  # READ | WRITE
    error: int = 0  # of `errno`; 0 = the calls succeed
    times: int = -1  # how many calls; -1 = all
    delay: float = 0.0  # seconds, before the call


class Control:
    """The faults of a group of processes: those that were started with `environment`. None at first."""

    def __init__(self, path: Path) -> None:
        self._path = path
        path.write_bytes(bytes(_HEADER.size + _RULES * _RULE.size))
        with path.open("r+b") as file:
            self._map = mmap.mmap(file.fileno(), 0)

    def environment(self, library: Path) -> Mapping[str, str]:
        """What the processes need."""
        names = {"LD_PRELOAD": str(library), "CHAOS_CONTROL": str(self._path)}
        return names | {"RAY_LD_PRELOAD_ON_WORKERS": "1"}  # Ray removes LD_PRELOAD for workers otherwise

    def add(self, rule: Rule) -> int:
        """Begins a fault. Returns its number. Raises RunError if there are too many."""
        for number in range(_RULES):
            at = _at(number)
            if not _RULE.unpack_from(self._map, at)[0]:
                delay, folder = round(rule.delay * 1e6), bytes(rule.folder.resolve())
                _RULE.pack_into(self._map, at, 0, rule.error, delay, rule.times, folder)
                struct.pack_into("=i", self._map, at, rule.calls)  # last: from now on it applies
                self._switch()
                return number
        raise RunError(f"at most {_RULES} faults of files at a time")

    def lift(self, number: int) -> None:
        """Ends a fault."""
        _RULE.pack_into(self._map, _at(number), 0, 0, 0, 0, b"")
        self._switch()

    def move_clock(self, seconds: int) -> None:
        """Sets the wall clock of these processes forward, or back, from the true time."""
        struct.pack_into("=q", self._map, 0, seconds * 10**9)

    def _switch(self) -> None:
        on = any(_RULE.unpack_from(self._map, _at(number))[0] for number in range(_RULES))
        struct.pack_into("=q", self._map, 8, on)


def _at(number: int) -> int:
    return _HEADER.size + number * _RULE.size
