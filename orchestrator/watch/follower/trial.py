"""One message to each target, now. Separate: the command line alone needs it, and a follower does not."""

import secrets
import time
from collections.abc import Iterator, Sequence

from panolog.orchestrator.watch.follower.notifications import trial_of
from panolog.orchestrator.watch.follower.sending import send
from panolog.orchestrator.watch.follower.targets import Target
from panolog.scene.errors import ConfigError


def try_targets(targets: Sequence[Target], name: str) -> Iterator[str]:
    """Sends each target a message about the run `name`. Yields the labels of those that took it.

    Raises ConfigError, once all were tried, with what the first that failed has answered.
    """
    wrong: list[str] = []
    for target in targets:
        refusal = send(target, trial_of(name, f"test-{secrets.token_hex(8)}", time.time()))
        if refusal is None:
            yield target.label
        else:
            wrong.append(f"{target.label}: {refusal.reason}")
    if wrong:
        raise ConfigError(f"notify {'; '.join(wrong)}; check the URL and the secrets: docs/notifications.md")
