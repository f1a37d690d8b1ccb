"""`panolog stop`, `pause`, `unpause` and `retry`: what can be asked of a run while its driver is at work."""

import time
from pathlib import Path
from typing import Annotated

import typer

from panolog.orchestrator.cli.app import RunArg, app, say

BlockArg = Annotated[int, typer.Argument(metavar="BLOCK", min=0, help="Number of a block.")]
_POLL = 0.5  # seconds between two looks at a run that is to end


@app.command()
def stop(run: RunArg) -> None:
    """End a run as Ctrl-C would, from anywhere; waits until its checkpoints are written."""
    from panolog.orchestrator.run import lock
    from panolog.orchestrator.run.folder import RunFolder

    _ask(run, "stop")
    while lock.held(RunFolder(run).lock):
        time.sleep(_POLL)
    say(f"its driver has ended; `panolog resume {run}` goes on")


@app.command()
def pause(run: RunArg, block: BlockArg) -> None:
    """Let a block wait, after a checkpoint; the run waits for it when all others are done."""
    _ask(run, "pause", block)
    say(f"asked; `panolog unpause {run} {block}` lets it go on")


@app.command()
def unpause(run: RunArg, block: BlockArg) -> None:
    """Let a paused block go on."""
    _ask(run, "unpause", block)
    say("asked; it goes on as soon as there is room")


@app.command()
def retry(run: RunArg, block: BlockArg) -> None:
    """Give a block that fails all its attempts again."""
    _ask(run, "retry", block)
    say("asked; it is tried again as soon as there is room")


def _ask(run: Path, action: str, block: int | None = None) -> None:
    """Raises InputError if there is nobody to ask or the run as it stands refuses."""
    from panolog.orchestrator.run import control
    from panolog.orchestrator.run.folder import RunFolder, read_head
    from panolog.orchestrator.run.policy import refusal
    from panolog.orchestrator.run.state import replay
    from panolog.orchestrator.run.store import read_milestones
    from panolog.scene.errors import InputError

    folder = RunFolder(run)
    read_head(folder)
    if (why := control.allowed(folder)) is not None:
        raise InputError(f"{run}: {why}")
    if (why := refusal(replay(read_milestones(folder.database)), control.request(action, block))) is not None:
        raise InputError(f"{run}: {control.request(action, block)}: {why}")
    control.ask(folder, action, block)
