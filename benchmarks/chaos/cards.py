"""`panolog` with GPUs that are files: a task for one first reads its file, then computes on the CPU.

    python -m benchmarks.chaos.cards FOLDER run …

One that cannot be read is a broken GPU. Ray on the head counts as many GPUs, a stand-in for nvidia-smi in
the same folder lists them, and as they differ in size the driver chooses which one a task gets.
"""

import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

from panolog.orchestrator.cli import app
from panolog.orchestrator.cli.session import supervise
from panolog.orchestrator.runs.machines.nodes import Placement
from panolog.workers.specs import TaskSpec

CARDS = ("GPU-0", "GPU-1")
_MEMORY_MIB = 16_000  # of the first; each has 2 GiB more than the one before


def make(folder: Path) -> None:
    """The cards, as files, and the program that lists them."""
    rows = [f"{i}, {name}, simulated, {_MEMORY_MIB + 2048 * i}, 24000" for i, name in enumerate(CARDS)]
    for name in CARDS:
        (folder / name).write_bytes(b"works")
    program = folder / "nvidia-smi"
    program.write_text("#!/bin/sh\ncat <<'END'\n" + "\n".join(rows) + "\nEND\n")
    program.chmod(0o755)


def _use_files(folder: Path) -> None:
    """Replaces what runs on workers; it is pickled as a whole, as it belongs to a program."""
    from panolog.orchestrator.engine.cluster import pool  # noqa: PLC0415  # the supervisor does without Ray

    def run(spec: TaskSpec, where: Placement, code: str) -> Iterator[Any]:
        from panolog.orchestrator.engine.cluster.pool import _run  # noqa: PLC0415  # the worker's own

        (folder / where.uuid).read_bytes()
        yield from _run(replace(spec, device="cpu"), where, code)

    pool._run = run


def main() -> None:
    """The program, and that of its drivers."""
    folder = sys.argv.pop(1)
    supervise._PROGRAM = (sys.executable, __file__, folder)
    if "--supervise" not in sys.argv:
        _use_files(Path(folder))
    app.main()


if __name__ == "__main__":
    main()
