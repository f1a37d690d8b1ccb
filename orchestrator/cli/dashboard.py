"""`panolog dashboard`: every run below a folder, in a browser. Separate: found by the command's name."""

from pathlib import Path
from typing import Annotated

from panolog.orchestrator.cli.console import say
from panolog.orchestrator.cli.syntax import argument, flag, option
from panolog.scene.errors import InputError

PORT = 8360  # fixed, so that an open page reconnects to a restarted server


def dashboard(
    folder: Annotated[Path, argument("FOLDER", "A folder with runs, or one run.")] = Path(),
    host: Annotated[
        str, option("ADDRESS", "Address to serve on; any but this machine's own requires a token.")
    ] = "127.0.0.1",
    port: Annotated[int, option("PORT", "Port to serve on; 0 = any free port.", min=0, max=65535)] = PORT,
    queue: Annotated[
        Path | None,
        option(
            "DIR",
            "Folder of the queue that the page of all runs shows. Default: as `panolog queue`.",
            "--queue",
        ),
    ] = None,
    open_: Annotated[bool, flag("Open the page in this machine's browser.", "--open")] = False,
) -> None:
    """Serve the runs below FOLDER as web pages, until Ctrl-C."""
    if not folder.is_dir():
        raise InputError(f"{folder}: is not a folder")
    from panolog.orchestrator.watch.dashboard import guard, server

    shown = _queue() if queue is None else queue.absolute()
    token = guard.token_for(host)
    listener = guard.listen(host, port)
    url = guard.address(listener, host, token)
    say(url)
    if token:
        what = "view and stop the runs and to change the queue"
        say(f"this URL grants access to {what}; its token is kept in {guard.token_file()}")
    if open_:
        import webbrowser

        webbrowser.open(url)
    server.serve(folder, listener, token, shown)


def _queue() -> Path | None:
    """The user's queue; None for a user without a home."""
    from panolog.orchestrator.runs.queue.database import default_folder
    from panolog.scene.errors import QueueError

    try:
        return default_folder()
    except QueueError:
        return None
