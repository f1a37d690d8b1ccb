"""Requests to the driver of a live run: stop, pause, unpause, retry, release."""

import time
from pathlib import Path
from typing import Annotated

import typer

from panolog.orchestrator.cli.console import command, progress_bar, say
from panolog.orchestrator.cli.options import BlockArg, RunArg

_POLL = 0.5  # seconds between two looks at a driver that stops


def stop(run: RunArg) -> None:
    """Stop a run as Ctrl-C does; returns when its checkpoints are written."""
    from panolog.orchestrator.run import lock
    from panolog.orchestrator.run.folder import RunFolder

    _request(run, "stop")
    with progress_bar("waiting until the checkpoints are written"):
        while lock.held(RunFolder(run).lock):
            time.sleep(_POLL)
    say(f"stopped; {command('resume', run)} resumes it")


def pause(run: RunArg, block: BlockArg) -> None:
    """Pause a block after its next checkpoint."""
    _request(run, "pause", block)
    say(f"requested; {command('unpause', run, block)} resumes the block")


def unpause(run: RunArg, block: BlockArg) -> None:
    """Resume a paused block."""
    _request(run, "unpause", block)
    say("requested; the block resumes when a worker is free")


def retry(run: RunArg, block: BlockArg) -> None:
    """Try a failed block again, with a full number of attempts."""
    _request(run, "retry", block)
    say("requested; the block starts when a worker is free")


def release(
    run: RunArg,
    node: Annotated[
        str, typer.Argument(metavar="NODE", help="Host of the machine, or the begin of its id; see status.")
    ],
) -> None:
    """Use a machine in quarantine again."""
    _request(run, "release", node=node)
    say("requested; the machine gets the next task that waits")


def _request(run: Path, action: str, block: int | None = None, node: str | None = None) -> None:
    """Sends a request to the driver. Raises InputError if no driver runs or the state does not allow it."""
    from panolog.orchestrator.run import control
    from panolog.orchestrator.run.folder import RunFolder, read_head
    from panolog.orchestrator.run.state import replay
    from panolog.orchestrator.run.store import read_milestones
    from panolog.scene.errors import InputError

    folder, wanted = RunFolder(run), control.request(action, block, node)
    read_head(folder)
    if (why := control.allowed(folder)) is not None:
        raise InputError(f"{run}: {why}")
    if (why := control.refusal(replay(read_milestones(folder.database)), wanted)) is not None:
        raise InputError(f"{run}: {wanted}: {why}")
    control.send(folder, action, block, node)
