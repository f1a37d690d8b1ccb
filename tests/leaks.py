"""A check after each test: nothing that it has started or made is left.

After a test and its fixtures no process, zombie, thread or listening socket of it may be left, and nothing in
the folder for temporary files, which each pytest process has for itself. What fixtures of a whole file hold
counts at the end of the file; then orphans, which have lost their parents, and shared memory count as well. A
fixture of the whole session calls `accept` when it has started something.
"""

import os
import shutil
import signal
import stat
import tempfile
import threading
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing.util import Finalize
from pathlib import Path

import pytest

WAIT_S = 120.0  # for what ends by itself, also on a busy machine
_PROC = Path("/proc")
_MEMORY = Path("/dev/shm")
_MINE = "PANOLOG_TESTS"  # in the environment of all processes that this one has started
# Helpers of Python itself; they end with this process.
_SERVERS = ("multiprocessing.forkserver", "multiprocessing.resource_tracker")
_POOLS = ("fsspecIO", "asyncio_", "AnyIO worker thread", "ray_", "tqdm")  # threads of libraries
_OF_A_FILE = ("dashboard_",)  # threads that a server of a whole file starts when it is used
# Files of Python, torch and ONNX Runtime, and memory that the browser of the session shares with its pages.
_CACHES = ("pymp-", "torchinductor_", ".ses", ".org.chromium.")

Found = dict[str, int]  # description -> the process, or 0


@dataclass
class _Held:
    """What existed when a test or a file began."""

    processes: set[int]
    threads: set[int | None]
    sockets: set[str]
    entries: set[str]
    memory: set[str]

    @classmethod
    def now(cls) -> "_Held":
        """What exists now."""
        threads = {it.ident for it in threading.enumerate()}
        return cls(set(_children()), threads, _sockets(), _entries(), _memory())

    def update(self, other: "_Held") -> None:
        """Adds what another one has."""
        for name, values in vars(other).items():
            getattr(self, name).update(values)


class LeakCheck:
    """The plugin: hooks of pytest around each test."""

    def __init__(self) -> None:
        self._file: _Held | None = None
        self._test: _Held | None = None

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_setup(self) -> Iterator[None]:
        """Keeps what exists before the first test of a file."""
        if self._file is None:
            self._file = _Held.now()
        yield
        self._test = _Held.now()

    @pytest.hookimpl(wrapper=True, tryfirst=True)
    def pytest_runtest_teardown(self, item: pytest.Item, nextitem: pytest.Item | None) -> Iterator[None]:
        """Fails a test that leaves something."""
        before, self._test = self._test, None
        yield
        last = nextitem is None or nextitem.path != item.path
        if last:
            before, self._file = self._file, None
        if before is None:  # its set-up has failed
            return
        before.update(_accepted)

        def left() -> Found:
            return {**_left(before), **(_left_of_a_file(before) if last else {})}

        found = _when_settled(left)
        if found:
            _end(found)
            accept()  # so that the next tests are not blamed
            pytest.fail("leaves " + "; ".join(found), pytrace=False)


_accepted = _Held(set(), set(), set(), set(), set())


def accept() -> None:
    """Declares that all that exists now stays until the end of the session."""
    _accepted.update(_Held.now())


def configure(config: pytest.Config) -> None:
    """Gives each process that runs tests a folder for temporary files, and registers the check."""
    if config.getoption("numprocesses", None) and "PYTEST_XDIST_WORKER" not in os.environ:
        return  # the process that distributes the tests to others
    os.environ.setdefault("PYTEST_DEBUG_TEMPROOT", tempfile.gettempdir())  # where pytest keeps `tmp_path`
    os.environ[_MINE] = str(os.getpid())
    folder = tempfile.mkdtemp(prefix="pano-")  # short: paths of sockets are limited to 107 bytes
    os.environ["TMPDIR"] = tempfile.tempdir = folder
    # After multiprocessing has removed its own folder there, at -100.
    Finalize(None, shutil.rmtree, (folder, True), exitpriority=-200)
    config.pluginmanager.register(LeakCheck(), "leaks")


def _when_settled(left: Callable[[], Found]) -> Found:
    """What is left when nothing more ends by itself."""
    end = time.monotonic() + WAIT_S
    while (found := left()) and time.monotonic() < end:
        time.sleep(0.05)
    return found


def _left(before: _Held) -> Found:
    """What exists now and did not before, but for what libraries keep."""
    found: Found = {}
    for pid in _children(before.processes):
        if pid not in before.processes and not (_parent(pid) == os.getpid() and _is_server(pid)):
            found[f"process {pid}: {_command(pid)}"] = pid
    found |= _threads(before, but=_POOLS + _OF_A_FILE)
    if new := _sockets() - before.sockets:
        found |= {f"listening socket {where}": 0 for inode, where in _listening() if inode in new}
    return found | {f"temporary file {name}": 0 for name in _entries() - before.entries}


def _left_of_a_file(before: _Held) -> Found:
    """Orphans that this process has started, with their test, and shared memory that no other process has."""
    found = _threads(before, but=_POOLS)
    known = before.processes | set(_children()) | {os.getpid()}
    mark = f"{_MINE}={os.getpid()}".encode()
    for pid in _numbers(_PROC):
        if pid not in known and _parent(pid) not in known:
            variables = _bytes(_PROC / str(pid) / "environ").split(b"\0")
            if mark in variables:
                test = next((v for v in variables if v.startswith(b"PYTEST_CURRENT_TEST=")), b"").decode()
                found[f"orphan {pid} ({test.partition('=')[2]}): {_command(pid)}"] = pid
    if new := _memory() - before.memory:
        maps = [_bytes(_PROC / str(pid) / "maps") for pid in _numbers(_PROC) if pid != os.getpid()]
        for name in new:
            if not any(name.encode() in content for content in maps):
                found[f"shared memory {name}"] = 0
    return found


def _threads(before: _Held, but: tuple[str, ...]) -> Found:
    """Threads that did not exist before. Args: but, the beginnings of names that do not count."""
    new = (it for it in threading.enumerate() if it.ident not in before.threads)
    return {f"thread {it.name}": 0 for it in new if not it.name.startswith(but)}


def _end(found: Found) -> None:
    """Kills and reaps processes, so that they do not disturb other tests."""
    for pid in filter(None, found.values()):
        with suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)
        with suppress(ChildProcessError):
            os.waitpid(pid, 0)


def _children(but: set[int] | None = None) -> Iterator[int]:
    """Processes below this one, also zombies. Args: but, not those below these, except servers of Python."""
    try:
        os.waitid(os.P_ALL, 0, os.WEXITED | os.WNOHANG | os.WNOWAIT)
    except ChildProcessError:
        return  # there is none, which is known much faster than by reading all of /proc
    below: dict[int, list[int]] = defaultdict(list)
    for pid in _numbers(_PROC):
        below[_parent(pid)].append(pid)
    waiting = [os.getpid()]
    while waiting:
        for pid in below[waiting.pop()]:
            yield pid
            if but is None or pid not in but or _is_server(pid):
                waiting.append(pid)


def _is_server(pid: int) -> bool:
    return any(name in _command(pid) for name in _SERVERS)


def _command(pid: int) -> str:
    """The command line of a process, or that it is a zombie."""
    words = _bytes(_PROC / str(pid) / "cmdline").replace(b"\0", b" ")
    return words.decode(errors="replace")[:300] or "a zombie"


def _parent(pid: int) -> int:
    """The parent of a process; 0 of one that is gone.

    It is read of all processes around each test; without Path and a file object, in a third of the time.
    """
    with suppress(OSError):
        file = os.open(f"{_PROC}/{pid}/stat", os.O_RDONLY)
        try:
            fields = os.read(file, 4096).rpartition(b")")[2].split()  # a name and 52 numbers: < 1200 bytes
        finally:
            os.close(file)
        return int(fields[1]) if fields else 0
    return 0


def _sockets() -> set[str]:
    """Inodes of the sockets of this process."""
    found = set()
    for number in _numbers(_PROC / "self" / "fd"):
        with suppress(OSError):
            status = os.fstat(number)  # in a hundredth of the time that links of /proc take
            if stat.S_ISSOCK(status.st_mode):
                found.add(str(status.st_ino))
    return found


def _listening() -> Iterator[tuple[str, str]]:
    """Inode and address of each listening socket of this machine."""
    for protocol in ("tcp", "tcp6"):
        for line in _bytes(_PROC / "self" / "net" / protocol).decode().splitlines()[1:]:
            _, local, _, state, *_, inode = line.split()[:10]
            if state == "0A":
                yield inode, f"{protocol} port {int(local.rpartition(':')[2], 16)}"
    for line in _bytes(_PROC / "self" / "net" / "unix").decode().splitlines()[1:]:
        _, _, _, flags, _, _, inode, *path = line.split()
        if flags == "00010000":
            yield inode, f"unix {' '.join(path)}"


def _entries() -> set[str]:
    names = _names(Path(tempfile.gettempdir()))
    return {name for name in names if not name.startswith(_CACHES)}


def _memory() -> set[str]:
    """Names of shared memory of this user."""
    found = set()
    for name in _names(_MEMORY):
        with suppress(OSError):
            temporary = name.startswith("sem.mp-")  # of multiprocessing, which removes it at once
            if not temporary and (_MEMORY / name).lstat().st_uid == os.getuid():
                found.add(name)
    return found


def _numbers(folder: Path) -> Iterator[int]:
    return (int(name) for name in _names(folder) if name.isdigit())


def _names(folder: Path) -> list[str]:
    """What a folder contains; nothing of one that is gone."""
    try:
        return os.listdir(folder)  # noqa: PTH208
    except OSError:
        return []


def _bytes(path: Path) -> bytes:
    """The content of a file of the kernel; nothing of a process that is gone or another user's."""
    try:
        return path.read_bytes()
    except OSError:
        return b""
