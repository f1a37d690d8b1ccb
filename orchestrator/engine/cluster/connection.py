"""Ray for as long as a run needs it: a cluster's, or one of its own on this machine.

What needs torch is imported once Ray starts: both take seconds.
"""

import logging
import os
import signal
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor, wait
from contextlib import contextmanager, redirect_stdout
from pathlib import Path
from tempfile import mkdtemp
from typing import TYPE_CHECKING

import psutil
import ray

from panolog.orchestrator.engine.cluster import cleaner as ray_cleaner
from panolog.orchestrator.runs import log
from panolog.orchestrator.runs.machines.machine import cores, memory
from panolog.orchestrator.runs.state import ignore
from panolog.scene.errors import ClusterError, ConfigError, first_line

if TYPE_CHECKING:
    from panolog.orchestrator.engine.cluster.pool import RayPool

_TMP = Path("/tmp")  # not below TMPDIR: the paths of Ray's sockets have at most 107 characters
_TIMEOUT_S = 10.0  # in which a cluster must answer, and Ray's own processes must end
_STARTS = 3  # of Ray on this machine, before it counts as broken
_STORE = 2**31  # bytes of shared memory for the object store, at most; beyond it Ray spills to disk


@contextmanager
def connect(
    address: str | None, root: Path, nice: int | None = None, meanwhile: Callable[[], None] = ignore
) -> Iterator["RayPool"]:
    """Ray for as long as the context lasts: a cluster's at `address`, or one of its own on this machine.

    Args: root, the folder of the run; nice, by how much workers are nicer than this process (setpriority(2),
    0 to 19), by default RAY_worker_niceness, else 0; meanwhile, called while Ray starts.
    Raises InputError if there is no cluster at the address, or for `nice` with one: its workers have the
    priority that its nodes gave them.
    """
    if address and nice is not None:
        raise ConfigError(
            f"--nice {nice}: only for runs on this machine; a cluster's workers have the priority that"
            " RAY_worker_niceness had when its nodes were started; leave the option out"
        )
    before = signal.getsignal(signal.SIGTERM)
    with (
        redirect_stdout(sys.stderr),
        _joined(address) if address else _own(nice, meanwhile),
    ):  # Ray prints what is lost
        # Ray has installed its own handler of SIGTERM: make it a Ctrl-C, so that the run records its end.
        unset = before in (None, signal.SIG_DFL)
        signal.signal(signal.SIGTERM, signal.default_int_handler if unset else before)
        if address:
            meanwhile()
        from panolog.orchestrator.engine.cluster.pool import RayPool  # noqa: PLC0415
        from panolog.orchestrator.engine.cluster.remote_files import FileSharing, key_of  # noqa: PLC0415

        sharing = FileSharing(root) if address else None
        pool = RayPool(sharing, key_of(root))
        try:
            yield pool
        finally:
            pool.close()
        if sharing is not None:
            sharing.clear()


@contextmanager
def _joined(address: str) -> Iterator[None]:
    try:
        _join(address)
        yield
    finally:
        ray.shutdown()


def _join(address: str) -> None:
    host, colon, port = address.removeprefix("ray://").rpartition(":")
    if address != "auto" and not (colon and port.isdecimal()):
        raise ClusterError(f"--address {address}: write auto or HOST:PORT")
    try:
        if address != "auto":  # Ray itself would try for two minutes
            socket.create_connection((host, int(port)), timeout=_TIMEOUT_S).close()
        ray.init(address=address, logging_level=logging.ERROR, log_to_driver=bool(log.environment()))
    except (OSError, OverflowError) as error:  # ConnectionError is an OSError
        raise ClusterError(
            f"--address {address}: no Ray cluster answers there ({first_line(str(error))});"
            " one that requires a token needs RAY_AUTH_MODE=token here"
        ) from error


@contextmanager
def _own(nice: int | None, meanwhile: Callable[[], None]) -> Iterator[None]:
    """A session of this machine, with a process that clears up, also if this one is killed."""
    nice = _niceness() if nice is None else nice
    folder = mkdtemp(prefix="panolog-ray-", dir=_TMP)
    command = [sys.executable, "-m", ray_cleaner.__name__, folder]
    cleaner = subprocess.Popen(command, stdin=subprocess.PIPE, start_new_session=True)
    others = set(psutil.Process().children(recursive=True))  # such as the follower of a run, which lives on
    try:
        with ThreadPoolExecutor(1) as thread:  # Ray's processes end with the thread that has started them
            starting = thread.submit(_start, folder, nice)
            try:
                meanwhile()
                starting.result()
                yield
            finally:
                wait([starting])
                _shut_down(others)
    finally:
        cleaner.communicate(b"ended")


def _start(folder: str, nice: int) -> None:
    """Starts Ray, and a worker; `_STARTS` times at most, as 30 s may be too short on a busy machine.

    Raises ClusterError if it does not start.
    """
    for left in reversed(range(_STARTS)):
        try:
            _init(folder, nice)
        except Exception as error:
            if type(error) is not Exception:  # what Ray raises for it has no class of its own
                raise
            ray.shutdown()
            if not left:
                raise ClusterError(
                    f"Ray does not start on this machine ({first_line(str(error))}); end other programs, and"
                    " repeat the command: nothing is lost"
                ) from error
        else:
            from panolog.orchestrator.engine.cluster.pool import imported  # noqa: PLC0415

            ray.remote(imported).remote()
            return


def _init(folder: str, nice: int) -> None:
    ray.init(
        address="local",  # also if RAY_ADDRESS is set
        num_cpus=cores(),
        include_dashboard=False,
        log_to_driver=bool(log.environment()),
        logging_level=logging.ERROR,
        object_store_memory=min(_STORE, memory() // 4),
        _temp_dir=folder,
        _system_config={"worker_niceness": nice},
    )


def _niceness() -> int:
    """The niceness of workers: Ray's variable, else 0: with Ray's own 15 they hardly run if others do."""
    given = os.environ.get("RAY_worker_niceness", "0")  # noqa: SIM112  # Ray's name
    try:
        return int(given)
    except ValueError as error:
        raise ConfigError(f"RAY_worker_niceness={given}: give a number from 0 to 19, or unset it") from error


def _shut_down(others: set[psutil.Process]) -> None:
    """Ends Ray and waits until its processes, all but `others`, have stopped to write."""
    processes = [p for p in psutil.Process().children(recursive=True) if p not in others]
    ray.shutdown()
    psutil.wait_procs(processes, timeout=_TIMEOUT_S)
