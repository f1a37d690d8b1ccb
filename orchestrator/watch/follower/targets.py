"""Where notifications go: `KIND:URL`, with a reference in place of a URL that is a secret.

The address of a Slack webhook is all that one needs to write there, and the topic of ntfy all that one needs
to read along: both are refused on a command line. Messages name a target by its label, which has no secret.
"""

import netrc
import os
import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from urllib.parse import SplitResult, urlsplit

from panolog.orchestrator.watch.follower.references import References, read_private
from panolog.scene.errors import ConfigError

VARIABLE = "PANOLOG_NOTIFY"  # targets, separated by space
WEBHOOK_SECRET, NTFY_TOKEN = "PANOLOG_NOTIFY_SECRET", "PANOLOG_NTFY_TOKEN"
SMTP_USER, SMTP_PASSWORD = "PANOLOG_SMTP_USER", "PANOLOG_SMTP_PASSWORD"
KINDS = ("webhook", "slack", "ntfy", "mail")
_SECRET_URLS = ("slack", "ntfy")
_MOST, _LONGEST = 20, 2048  # targets; characters of a URL


@dataclass(frozen=True)
class Target:
    """One place that gets notifications."""

    kind: str  # of KINDS
    label: str  # names it in messages and files, without a secret
    url: str = field(repr=False)
    user: str = field(default="", repr=False)  # of the mail server
    secret: str = field(default="", repr=False)  # signs a webhook; token of ntfy; password of the mail server


def read_targets(given: Sequence[str], references: References) -> tuple[Target, ...]:
    """The targets of a command line, as TARGETs of `--notify`, and those of PANOLOG_NOTIFY.

    Raises ConfigError for what is no target, has a secret in the wrong place, or cannot be read.
    """
    found: list[Target] = []
    for text in given:
        found += _read(text, f"--notify {_shown(text)}", references)
    found += _listed(references.variable(VARIABLE), VARIABLE, references)
    if len(found) > _MOST:
        raise ConfigError(f"--notify: {len(found)} targets; give at most {_MOST}")
    labels = [target.label for target in found]
    if twice := next((label for label in labels if labels.count(label) > 1), None):
        raise ConfigError(f"--notify: the target {twice} is given twice; give it once, or use @FILE for each")
    return tuple(found)


def check_elsewhere(text: str) -> None:
    """Checks a target of `--notify` for a command on another machine, which alone can read references.

    Raises ConfigError for what is no target, has a secret in the wrong place, or names a file that depends on
    where that command begins.
    """
    what, (kind, _, rest) = f"--notify {_shown(text)}", text.partition(":")
    reference = next((it for it in (text, rest) if it.startswith(("@", "env:"))), None)
    if reference is None:
        _read(text, what, References({"NETRC": os.devnull}))
        return
    if reference != text and kind not in KINDS:
        raise ConfigError(f"{what}: write KIND:URL, with one of the kinds {', '.join(KINDS)}")
    name = reference.removeprefix("env:")
    if name == reference and not reference.startswith(("@/", "@~")):
        raise ConfigError(f"{what}: the file is on the machine of the run; write it from / on")
    if name != reference and not re.fullmatch(r"[A-Za-z_]\w*", name, re.ASCII):
        raise ConfigError(f"{what}: write env:NAME, with the name of a variable on the machine of the run")


def _read(text: str, what: str, references: References) -> list[Target]:
    if (several := references.read(text, what)) is not None:
        return _listed(several, text, references)
    kind, _, rest = text.partition(":")
    if (url := references.read(rest, what)) is not None:
        return [_target(kind, url, text, what, references)]
    if kind in _SECRET_URLS:
        raise ConfigError(
            f"{what}: its URL is a secret, and others can see a command line; put it into a file of mode 600"
            f" (--notify {kind}:@FILE) or into an environment variable (--notify {kind}:env:NAME)"
        )
    if "?" in rest:
        raise ConfigError(
            f"{what}: a URL with a query may hold a secret; use {kind}:@FILE or {kind}:env:NAME"
        )
    return [_target(kind, rest, _shown(text), what, references)]


def _listed(text: str, where: str, references: References) -> list[Target]:
    """The targets in a file or variable, separated by space; its lines that begin with # are comments."""
    words = [word for line in text.splitlines() if not line.startswith("#") for word in line.split()]
    found = []
    for number, word in enumerate(words, 1):
        kind, _, rest = word.partition(":")
        label = f"{where}#{number}"
        url = references.read(rest, label)
        found.append(_target(kind, rest if url is None else url, label, label, references))
    return found


def _target(kind: str, url: str, label: str, what: str, references: References) -> Target:
    if kind not in KINDS:
        raise ConfigError(f"{what}: write KIND:URL, with one of the kinds {', '.join(KINDS)}")
    parts = _checked(kind, url, what)
    user = ""
    if kind == "mail":
        user, secret = _mail_account(parts.hostname or "", references)
    else:
        variable = {"webhook": WEBHOOK_SECRET, "ntfy": NTFY_TOKEN}.get(kind)
        secret = references.secret(variable) if variable else ""
    return Target(kind, label, url, user, secret)


def _checked(kind: str, url: str, what: str) -> SplitResult:
    """The parts of a URL. Raises ConfigError without showing it."""
    schemes = ("smtp", "smtps") if kind == "mail" else ("https", "http")
    form = "smtp://HOST:PORT/TO" if kind == "mail" else "https://HOST/PATH"
    wrong = ConfigError(f"{what}: is not a URL of the form {form}; write it so")
    try:
        parts = urlsplit(url)
        valid = parts.scheme in schemes and bool(parts.hostname) and parts.port != 0
    except ValueError as error:
        raise wrong from error
    if not valid or not url.isascii() or not url.isprintable() or " " in url or len(url) > _LONGEST:
        raise wrong
    if parts.username is not None or parts.fragment:
        raise ConfigError(
            f"{what}: user, password and # are no part of the URL; docs/notifications.md has their variables"
        )
    last = parts.path.rpartition("/")[2]
    if (kind == "mail" and "@" not in parts.path) or (kind in _SECRET_URLS and not last):
        raise wrong
    return parts


def _mail_account(host: str, references: References) -> tuple[str, str]:
    """User and password of a mail server, from variables or from netrc; "" if there are none."""
    if user := references.variable(SMTP_USER):
        return user, references.secret(SMTP_PASSWORD)
    path = Path(references.environment.get("NETRC") or Path.home() / ".netrc")
    if not path.is_file():
        return "", ""
    read_private(path, f"mail to {host}")  # refuses one that others may read
    try:
        entry = netrc.netrc(path).authenticators(host)
    except (netrc.NetrcParseError, UnicodeDecodeError) as error:  # its text may quote a password
        line = getattr(error, "lineno", None)
        raise ConfigError(f"{path}: line {line} is not of netrc's format; correct it") from error
    return (entry[0], entry[2] or "") if entry else ("", "")


def _shown(text: str) -> str:
    """A target as messages show it: a reference as it is, of a URL its host alone."""
    kind, _, rest = text.partition(":")
    if text.startswith(("@", "env:")) or rest.startswith(("@", "env:")):
        return text
    try:
        parts = urlsplit(rest)
        return f"{kind}:{parts.scheme}://{parts.hostname}/…" if parts.hostname else "…"
    except ValueError:
        return "…"
