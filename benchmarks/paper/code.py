"""Which code has measured a result: a fingerprint of the sources that decide a training, and a readable name.

Neither the commit nor the package's version would do alone: most commits change nothing of a training, and
sources may have changes that are in no commit.
"""

import subprocess
from dataclasses import dataclass
from pathlib import Path

import panolog
from panolog.orchestrator.runs.info import fingerprint

_ROOT = Path(panolog.__file__).parent
_PACKAGES = ("scene", "renderer", "partition", "workers", "orchestrator/engine/driver")


@dataclass(frozen=True)
class Code:
    """The sources as they are on disk."""

    sources: str  # fingerprint, hexadecimal
    name: str  # the commit, with the fingerprint where it does not say all


def present(root: Path = _ROOT) -> Code:
    """The code that a run would be trained with now. Args: root, the folder of the package."""
    sources = fingerprint(_PACKAGES, root)
    return Code(sources, _commit(root, sources))


def _commit(root: Path, sources: str) -> str:
    """Of the checkout that `root` belongs to, or the fingerprint alone."""
    checkout = (root / _PACKAGES[0]).resolve().parent
    commit = _git(checkout, "rev-parse", "--short=9", "HEAD")
    if commit is None:
        return f"sources {sources}"
    changed = _git(checkout, "status", "--porcelain", "--", *_PACKAGES)
    return f"{commit} with changes, sources {sources}" if changed else commit


def _git(checkout: Path, *words: str) -> str | None:
    """What git says; None where there is no git or no checkout."""
    try:
        command = ["git", "-C", str(checkout), *words]
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        return None
