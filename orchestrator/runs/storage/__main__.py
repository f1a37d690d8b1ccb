"""The process of a mirror: gets its settings in the first line of stdin, and ends after stdin does.

It says what its parent needs as JSON lines on stdout. It ignores the signals that end a run, so that it
copies the last checkpoints; SIGTERM ends it. Separate: it is a program.
"""

import json
import signal
import sys
import threading
from contextlib import suppress

from panolog.orchestrator.runs import control, lock
from panolog.orchestrator.runs.folder import RunFolder
from panolog.orchestrator.runs.storage.fetch import bring
from panolog.orchestrator.runs.storage.layout import Manifest, current
from panolog.orchestrator.runs.storage.lease import Lease, take
from panolog.orchestrator.runs.storage.mirror import Mirror
from panolog.orchestrator.runs.storage.mirror_settings import MIRROR_SETTINGS, MirrorSettings
from panolog.orchestrator.runs.units import gib
from panolog.scene.errors import (
    InputError,
    PanologError,
    RunFolderError,
    StoreError,
    StoreLostError,
    in_one_line,
)
from panolog.scene.stores.store import Store, open_store

_PATIENCE_S = 30.0  # of one request: the mirror itself tries again


def main() -> None:
    for number in (signal.SIGINT, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)
    line = sys.stdin.readline()
    if not line.endswith("\n"):  # its parent has ended before
        return
    settings = MIRROR_SETTINGS.validate_json(line)
    ended, stop = threading.Event(), threading.Event()
    signal.signal(signal.SIGTERM, lambda *_: stop.set())
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGTERM})  # blocked where another one was killed

    def wait() -> None:
        sys.stdin.read()
        ended.set()

    threading.Thread(target=wait, daemon=True).start()
    try:
        store, lease, manifest = _begun(settings)
    except (PanologError, OSError) as error:
        _tell(error=in_one_line(error), code=2 if isinstance(error, InputError) else 1)
        return
    _tell(ready=True)
    _follow(settings, Mirror(RunFolder(settings.root), store, lease, manifest), lease, ended, stop)


def _begun(settings: MirrorSettings) -> tuple[Store, Lease, Manifest | None]:
    """Takes the lease, and brings the run if it is to be resumed. Raises PanologError."""
    folder, store = RunFolder(settings.root), open_store(settings.url, _PATIENCE_S)
    lease = take(store, settings.root, force=settings.force, again=settings.again)
    try:
        manifest = current(store)
        if settings.again:
            return store, lease, manifest
        if settings.resumes:
            bring(store, folder, manifest, lambda line: _tell(say=line))
        elif manifest is not None:
            raise RunFolderError(f"{store.url}: holds a run; use `panolog resume {store.url}`")
    except (PanologError, OSError):
        with suppress(StoreError, StoreLostError):
            lease.release()
        raise
    return store, lease, manifest


def _follow(
    settings: MirrorSettings, mirror: Mirror, lease: Lease, ended: threading.Event, stop: threading.Event
) -> None:
    folder = RunFolder(settings.root)
    mirror.follow(ended, stop, settings.period, settings.patience)
    with suppress(StoreError, StoreLostError):
        lease.release()
    if lease.lost and lock.held(folder.lock):  # what is trained from now on would be lost
        with suppress(InputError, OSError):
            control.send(folder, "stop")
    state = mirror.state
    if not state.complete:
        left = (
            f"{state.pending_files:,} files, {gib(state.pending_bytes)}" if state.pending_files else "its end"
        )
        _tell(left=f"not all of the run is in {state.url}: {left} ({state.problem or 'stopped'})")


def _tell(**content: object) -> None:
    with suppress(OSError):  # the parent is gone
        print(json.dumps(content), flush=True)


if __name__ == "__main__":
    main()
