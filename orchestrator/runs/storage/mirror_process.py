"""The mirror as a process next to the driver: `mirrored` keeps it while a run lasts, and until all is out."""

import json
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from typing import Any

from panolog.orchestrator.runs.machines.children import ENDS, start_companion
from panolog.orchestrator.runs.storage.mirror_settings import MIRROR_SETTINGS, MirrorSettings
from panolog.scene.errors import RunError, StoreError

_AGAIN_S, _LONGEST_S = 10.0, 600.0  # before a mirror that was killed is started again: first, at most
_TRIES = 3  # of mirrors in a row that end at once, after the end of the run
_STOP_S = 10.0  # for a mirror to say what is left after it was stopped
Say = Callable[[str], None]


@contextmanager
def mirrored(settings: MirrorSettings | None, say: Say) -> Iterator[None]:
    """Mirrors a run while the context lasts, then until the store has all of it. The run never waits for it.

    The context begins when the run is this command's, and on this machine if it is to be resumed. A mirror
    that was killed is started again. Args: settings, None for a run in no store; say, called with lines.
    Raises StoreError if the run is another driver's, or cannot be brought; after the context RunError if the
    store does not have all of it.
    """
    if settings is None:
        yield
        return
    say(f"the run is in {settings.root} on this machine, and is copied to {settings.url} as it proceeds")
    mirror = _Keeper(settings, say)
    try:
        yield
    except BaseException:
        if left := mirror.finish():
            say(left)
        raise
    if left := mirror.finish():
        raise RunError(left)


class _Keeper:
    def __init__(self, settings: MirrorSettings, say: Say) -> None:
        self._settings, self._say = settings, say
        self._left = ""
        self._ended = threading.Event()
        self._start(settings)
        self._begin()
        self._thread = threading.Thread(target=self._keep, name="mirror", daemon=True)
        # A thread has the mask of the one that starts it: requests to stop go to the main thread, also in a
        # supervisor, which takes them with `sigtimedwait`.
        before = signal.pthread_sigmask(signal.SIG_BLOCK, ENDS)
        try:
            self._thread.start()
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)

    def finish(self) -> str:
        """Ends the mirror when all is out. Returns what is not; Ctrl-C ends the wait."""
        self._ended.set()
        self._end_input()
        try:
            while self._thread.is_alive():
                self._thread.join(1.0)
        except KeyboardInterrupt:
            self._process.terminate()
            self._thread.join(_STOP_S)
            self._process.kill()
            return self._left or f"not all of the run is in {self._settings.url}: interrupted"
        hint = f"`panolog resume {self._settings.url}` on this machine copies the rest"
        return f"{self._left}; {hint}" if self._left else ""

    def _start(self, settings: MirrorSettings) -> None:
        line = MIRROR_SETTINGS.dump_json(settings).decode()
        self._process = start_companion("panolog.orchestrator.runs.storage", line)

    def _end_input(self) -> None:
        """Lets the mirror end when all is out."""
        with suppress(OSError):
            assert self._process.stdin is not None
            self._process.stdin.close()

    def _begin(self) -> None:
        """Waits until the mirror is at work. Raises StoreError with its line if it cannot be."""
        for content in self._lines():
            if "error" in content:
                self._process.wait()
                kind = StoreError if content.get("code") == 2 else RunError
                raise kind(str(content["error"]))
            if content.get("ready"):
                return
            self._say(str(content.get("say", "")))
        code = self._process.wait()
        raise RunError(f"{self._settings.url}: the process of its mirror has ended (code {code})")

    def _keep(self) -> None:
        """Reads what the mirror says, and starts another one if it was killed; later each time."""
        pause, tries = _AGAIN_S, 0
        while True:
            began = time.monotonic()
            for content in self._lines():
                self._left = str(content.get("left", "")) or self._left
            if self._process.wait() == 0:
                return
            code, complaint = f"code {self._process.returncode}", self._process.complaint
            why = f"{code}: {complaint}" if complaint else code
            self._left = killed = f"{self._settings.url}: its mirror was killed ({why})"
            if time.monotonic() - began > _LONGEST_S:
                pause, tries = _AGAIN_S, 0
            last = self._ended.wait(pause)
            pause, tries = min(2 * pause, _LONGEST_S), tries + 1
            if last and tries > _TRIES:
                return
            self._start(replace(self._settings, again=True, force=False))  # in place of one that was killed
            if last:
                self._end_input()
            try:
                self._begin()
                self._left = ""
                self._say(f"{killed}; another one is at work")
            except (StoreError, RunError) as error:
                self._left = str(error)
                self._say(f"{killed}, and another one cannot work: {error}")
                if last:
                    return

    def _lines(self) -> Iterator[dict[str, Any]]:
        assert self._process.stdout is not None
        for line in self._process.stdout:
            with suppress(ValueError):
                yield json.loads(line)
