"""Secrets by reference: `env:NAME` is an environment variable, `@FILE` a file that only its owner can read.

A command line is visible to every user of a machine, in the list of its processes; these two are not.
"""

import os
import stat
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from panolog.scene.errors import ConfigError

_MOST = 64 * 1024  # bytes of a file


@dataclass
class References:
    """Reads references, and remembers which variables held secrets."""

    environment: Mapping[str, str]
    used: set[str] = field(default_factory=set)  # names of variables that were read

    def variable(self, name: str) -> str:
        """The value of a variable, "" if there is none."""
        self.used.add(name)
        return self.environment.get(name, "").strip()

    def read(self, text: str, what: str) -> str | None:
        """What a reference stands for; None if the text is none.

        Args: what, begins the message of an error. Raises ConfigError if there is nothing to read.
        """
        if text.startswith("@"):
            return read_private(Path(text[1:]).expanduser(), what)
        if not text.startswith("env:"):
            return None
        name = text.removeprefix("env:")
        if not (value := self.variable(name)):
            raise ConfigError(f"{what}: the environment variable {name} is not set; export it first")
        return value

    def secret(self, name: str) -> str:
        """A secret in a variable, or in a file that the variable names as `@FILE`; "" if it is not set.

        Raises ConfigError as `read`, or if it is more than one line of printable ASCII.
        """
        value = self.variable(name)
        if value.startswith("@"):
            value = read_private(Path(value[1:]).expanduser(), name)
        if not (value.isascii() and value.isprintable()):
            raise ConfigError(f"{name}: the secret has to be one line of printable ASCII characters")
        return value


def read_private(path: Path, what: str) -> str:
    """The text of a file of secrets, without space around it.

    Raises ConfigError if it is no plain file of UTF-8, is empty or too large, or others have rights on it.
    """
    try:
        handle = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
        with os.fdopen(handle, "rb") as file:
            status = os.fstat(handle)
            content = file.read(_MOST + 1) if stat.S_ISREG(status.st_mode) else None
    except OSError as error:
        raise ConfigError(
            f"{what}: {path} cannot be read: {error.strerror}; write the secret there"
        ) from error
    if content is None:
        raise ConfigError(f"{what}: {path} is not a plain file; name one that holds the secret")
    if status.st_mode & 0o077:
        raise ConfigError(f"{what}: other users have rights on {path}; take them away: chmod 600 {path}")
    if len(content) > _MOST:
        raise ConfigError(f"{what}: {path} has more than {_MOST} bytes; name a file with the secret alone")
    try:
        text = content.decode().strip()
    except UnicodeDecodeError as error:
        raise ConfigError(f"{what}: {path} is not text in UTF-8; write it anew") from error
    if not text:
        raise ConfigError(f"{what}: {path} is empty; write the secret there")
    return text
