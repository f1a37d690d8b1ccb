"""What commands print on stderr besides their progress."""

import re

# After three seconds without a terminal, a command says how far it is: on a slow machine any command does.
_PROGRESS = re.compile(r".+: (\d+ s|[\d,]+ of [\d,]+)")


def without_progress(stderr: str) -> list[str]:
    """The lines that are not about progress."""
    return [line for line in stderr.splitlines() if not _PROGRESS.fullmatch(line)]
