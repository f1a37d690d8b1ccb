"""What a step is given and what it gives back: as files, because each step is a process of its own."""

import json
import shlex
import subprocess
import sys
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal

from panolog.scene.files import write_bytes

ROOT = Path(__file__).resolve().parents[2]  # of the repository: the folder that has tests/ and docs/
NO_CARD = "no card"
Ending = Literal["passed", "failed", "skipped"]


@dataclass(frozen=True)
class Outcome:
    """How a step ended."""

    ending: Ending
    figure: str = ""  # the one number of the summary
    reason: str = ""  # why it failed or was skipped
    commands: tuple[str, ...] = ()  # that do the same by hand, from the root of the repository
    content: dict[str, Any] = field(default_factory=dict)  # for JSON
    text: str = ""  # Markdown


@dataclass(frozen=True)
class Context:
    """What a step is given."""

    step: str
    folder: str  # of all results, absolute
    device: str  # "cuda", or "cpu" for a rehearsal
    seconds: float  # after which the step is stopped
    scene: str | None = None  # a folder, absolute
    model: str | None = None  # a PLY that was trained on it, absolute

    @property
    def cuda(self) -> bool:
        """Whether a card is measured; otherwise steps are reduced to what a rehearsal needs."""
        return self.device == "cuda"

    @property
    def work(self) -> Path:
        """The step's own folder."""
        return Path(self.folder, self.step)

    def save(self, outcome: Outcome) -> None:
        """Writes the result; a later call replaces it, so that what is measured so far outlives the step."""
        write_bytes(result_file(self.folder, self.step), json.dumps(asdict(outcome)).encode())


def result_file(folder: str | Path, step: str) -> Path:
    """Where the process of a step leaves its result."""
    return Path(folder, step, "result.json")


def python(*arguments: str) -> list[str]:
    """A command of this Python."""
    return [sys.executable, *arguments]


def shown(command: Sequence[str]) -> str:
    """A command as it is written on the page: with `python` for this Python."""
    return shlex.join(["python" if part == sys.executable else part for part in command])


def call(command: Sequence[str], environment: Mapping[str, str], seconds: float) -> None:
    """Runs a command in the root of the repository, for so many seconds at most; it prints to the log."""
    print("$", shown(command), flush=True)
    with suppress(subprocess.TimeoutExpired):
        subprocess.run(command, cwd=ROOT, env=environment, check=False, timeout=seconds)
