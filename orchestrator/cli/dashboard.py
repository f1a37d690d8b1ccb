"""`panolog dashboard`: every run below a folder, in a browser."""

import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from subprocess import DEVNULL, PIPE
from threading import Thread
from typing import Annotated

import typer

from panolog.orchestrator.cli.app import app, say
from panolog.scene.errors import InputError

PORT = 8360  # always the same, so that an open page finds the server again
_FAREWELL = 5.0  # seconds in which a dashboard beside a run must have ended


@app.command()
def dashboard(
    folder: Annotated[Path, typer.Argument(metavar="[FOLDER]", help="Shows every run below it.")] = Path(),
    host: Annotated[
        str, typer.Option(metavar="ADDRESS", help="Any but this machine's own needs a token.")
    ] = ("127.0.0.1"),
    port: Annotated[int, typer.Option(metavar="PORT", min=0, max=65535, help="0 = a free one.")] = PORT,
    open_: Annotated[bool, typer.Option("--open", help="Open it in this machine's browser.")] = False,
) -> None:
    """Serve every run below FOLDER as web pages, until Ctrl-C."""
    if not folder.is_dir():
        raise InputError(f"{folder}: is not a folder")
    from panolog.orchestrator.dashboard import server

    token = server.token_for(host, server.token_file())
    listener = server.listen(host, port)
    url = server.address(listener, host, token)
    say(url)
    if token:
        say(f"whoever has it can look at the runs and stop them; the token is kept in {server.token_file()}")
    if open_:
        import webbrowser

        webbrowser.open(url)
    server.serve(folder, listener, token)


class Beside:
    """The process of a dashboard beside a run."""

    def __init__(self, run: Path) -> None:
        """Raises OSError if it cannot be started."""
        command = [sys.executable, "-m", "panolog.orchestrator.dashboard.companion", str(run.absolute())]
        # A session of its own: Ctrl-C is for the driver, whose last words the page shows.
        self._process = subprocess.Popen(
            command, stdin=PIPE, stdout=PIPE, stderr=DEVNULL, text=True, start_new_session=True
        )
        self.told = Thread(target=self._tell, daemon=True)
        self.told.start()

    def end(self) -> None:
        """Ends it."""
        self._process.terminate()
        try:
            self._process.wait(_FAREWELL)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()

    def _tell(self) -> None:
        """Says its URL as soon as it has one, once."""
        assert self._process.stdout is not None
        url = self._process.stdout.readline().strip()
        say(f"dashboard {url}" if url else "there is no dashboard: its process has ended")


@contextmanager
def beside(run: Path) -> Iterator[Beside | None]:
    """A dashboard of one run while the context lasts; whatever becomes of it, the run goes on."""
    try:
        process = Beside(run)
    except OSError as error:
        say(f"there is no dashboard: {error.strerror}")
        yield None
        return
    try:
        yield process
    finally:
        process.end()
