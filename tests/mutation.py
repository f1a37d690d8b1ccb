"""Breaks one line at a time, and reports which tests notice: `python -m tests.mutation [FILE]`.

FILE, by default tests/mutants.json, lists mutants: a file, a text that it contains once, what takes its
place, the claim that breaks, and the tests that should find it. The files are changed in this checkout, one
after the other, and restored; use one in which no one else works. The exit code is 1 if a mutant survives.
"""

import argparse
import json
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

ROOT = Path(__file__).parents[1]
_LONGEST_S = 900  # a mutant that hangs is found


def finds(mutant: dict[str, str], tests: Sequence[str]) -> bool:
    """Whether a test fails while a mutant is in place. Raises ValueError if it does not fit its file."""
    path = ROOT / mutant["file"]
    text = path.read_text()
    if text.count(mutant["old"]) != 1:
        raise ValueError(f"{mutant['file']}: contains {text.count(mutant['old'])} times: {mutant['old']}")
    options = ("-x", "-q", "-m", "not nightly", "-p", "no:cacheprovider")
    command = [sys.executable, "-m", "pytest", *options, *tests]
    path.write_text(text.replace(mutant["old"], mutant["new"]))
    try:
        ended = subprocess.run(
            command, cwd=ROOT, check=False, timeout=_LONGEST_S, capture_output=True, text=True
        )
    except subprocess.TimeoutExpired:
        return True
    finally:
        path.write_text(text)
    if ended.returncode not in (0, 1, 2):
        raise ValueError(f"{mutant['file']}: pytest ended with {ended.returncode}:\n{ended.stdout}")
    return ended.returncode != 0


def main(arguments: Sequence[str] | None = None) -> int:
    """The program; returns its exit code."""
    parser = argparse.ArgumentParser("tests.mutation", description=__doc__.split("\n\n")[0])
    parser.add_argument("file", type=Path, nargs="?", default=Path(__file__).with_name("mutants.json"))
    parser.add_argument("--tests", action="append", help="run these instead of those that a mutant names")
    options = parser.parse_args(arguments)
    mutants, survived = json.loads(options.file.read_text()), 0
    for mutant in mutants:
        try:
            found = "found" if finds(mutant, options.tests or mutant["tests"]) else "SURVIVES"
        except ValueError as error:
            found = str(error)
        survived += found != "found"
        print(f"| {mutant['file']} | {mutant['why']} | {found} |", flush=True)
    print(f"{len(mutants) - survived} of {len(mutants)} found")
    return 1 if survived else 0


if __name__ == "__main__":
    sys.exit(main())
