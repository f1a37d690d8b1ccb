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

from panolog.orchestrator.cli import app, say
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


@contextmanager
def beside(run: Path) -> Iterator[None]:
    """A dashboard of one run, in a process of its own, while the context lasts. Says its URL once."""
    command = [sys.executable, "-m", "panolog.orchestrator.dashboard.companion", str(run.absolute())]
    try:
        # A session of its own: Ctrl-C is for the driver, whose last words the page shows.
        process = subprocess.Popen(
            command, stdin=PIPE, stdout=PIPE, stderr=DEVNULL, text=True, start_new_session=True
        )
    except OSError as error:
        say(f"there is no dashboard: {error.strerror}")
        yield
        return
    Thread(target=_tell_url, args=(process,), daemon=True).start()
    try:
        yield
    finally:
        process.terminate()
        try:
            process.wait(_FAREWELL)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


def _tell_url(process: "subprocess.Popen[str]") -> None:
    assert process.stdout is not None
    url = process.stdout.readline().strip()
    say(f"dashboard {url}" if url else "there is no dashboard: its process has ended")
