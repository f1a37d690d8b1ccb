"""`panolog notify`: a test message to each target. Separate: a group of commands."""

import os
import secrets
import time
from pathlib import Path
from typing import Annotated

import typer

from panolog.orchestrator.cli.console import say
from panolog.orchestrator.cli.options import NotifyOption
from panolog.orchestrator.cli.syntax import Command, Group, argument
from panolog.scene.errors import ConfigError

app = typer.Typer(cls=Group, no_args_is_help=True, help="Notifications of runs: test.")


@app.callback()
def _notify() -> None:
    """Notifications of runs."""


@app.command(cls=Command)
def test(
    run: Annotated[Path, argument("RUN", "Folder that the message names.")] = Path(),
    notify: NotifyOption = None,
) -> None:
    """Send a test message to the targets of --notify and of PANOLOG_NOTIFY."""
    from panolog.orchestrator.watch.follower.notifications import trial_of
    from panolog.orchestrator.watch.follower.recipients import read_recipients
    from panolog.orchestrator.watch.follower.sending import send

    recipients, _ = read_recipients(notify or (), (), os.environ)
    if not recipients.targets:
        raise ConfigError("notify test: there is no target; give --notify KIND:URL or set PANOLOG_NOTIFY")
    wrong = []
    for target in recipients.targets:
        refusal = send(target, trial_of(run.resolve().name, f"test-{secrets.token_hex(8)}", time.time()))
        if refusal is None:
            say(f"sent to {target.label}")
        else:
            wrong.append(f"{target.label}: {refusal.reason}")
    if wrong:
        raise ConfigError(f"notify {'; '.join(wrong)}; check the URL and the secrets: docs/notifications.md")
