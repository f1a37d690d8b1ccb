"""Prints the files with nightly tests that a change touches: `python -m tests.touched REVISION`.

A file is touched by a change since the revision to itself, or to the folder of the package that it mirrors:
`tests/export/gltf/test_tiles.py` by `export/gltf/`.
"""

import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parents[1]


def nightly_files() -> Iterator[Path]:
    """Test files with a nightly test, relative to the root."""
    for path in sorted((ROOT / "tests").rglob("test_*.py")):
        if "mark.nightly" in path.read_text():
            yield path.relative_to(ROOT)


def touched(changed: set[Path]) -> Iterator[Path]:
    """The files with nightly tests that changed files, relative to the root, touch."""
    for file in nightly_files():
        mirrored = Path(*file.parent.parts[1:])
        if file in changed or any(mirrored in path.parents for path in changed):
            yield file


def main(revision: str) -> None:
    """Prints them on one line."""
    command = ["git", "diff", "--name-only", revision]
    names = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout.split()
    print(*touched({Path(name) for name in names}))


if __name__ == "__main__":
    main(sys.argv[1])
