"""`make stress`: the suite under load, in random order and on one core, and what has failed at least once.

    python -m tests.stress [--variants load,random,core] [--rounds N] [--log FILE] [FILE ...]

A variant is `idle`, `load` (busy processes, memory that is written and files that are flushed), `random`
(another order in each round) or `core` (all processes on one core), or several of them with `+`. Each line of
the log has the start, the end, the variant, the load average at the end and the result. The exit code is 1 if
anything has failed.
"""

import argparse
import itertools
import os
import subprocess
import sys
import tempfile
import time
import xml.etree.ElementTree as ET
from collections import defaultdict
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from multiprocessing import get_context
from pathlib import Path

PARTS = ("idle", "load", "random", "core")
_LONGEST_S = 3 * 3600  # after which load ends whatever happens
_MEMORY = 256 * 2**20  # bytes that are written again and again
_FILE = 32 * 2**20  # bytes that are flushed again and again


def burn(kind: str, parent: int) -> None:
    """Keeps a core, the memory or the disk busy as long as the parent lives, for some hours at most."""
    end = time.monotonic() + _LONGEST_S
    memory = bytearray(_MEMORY if kind == "memory" else _FILE)
    with tempfile.TemporaryFile() as file:
        while os.getppid() == parent and time.monotonic() < end:
            if kind == "disk":
                file.seek(0)
                file.write(memory)
                file.flush()
                os.fsync(file.fileno())
            elif kind == "memory":
                memory[:] = os.urandom(2**20) * (_MEMORY // 2**20)
            else:
                sum(number * number for number in range(200_000))


@contextmanager
def load() -> Iterator[None]:
    """Two busy processes for each core, one that writes memory and one that flushes files."""
    context = get_context("spawn")
    kinds = ["core"] * 2 * len(os.sched_getaffinity(0)) + ["memory", "disk"]
    processes = [context.Process(target=burn, args=(kind, os.getpid()), daemon=True) for kind in kinds]
    for process in processes:
        process.start()
    try:
        yield
    finally:
        for process in processes:
            process.terminate()
            process.join()


def run(variant: str, seed: int, arguments: Sequence[str]) -> tuple[list[str], str]:
    """Runs the tests once. Returns the names of those that failed, and a summary."""
    parts = variant.split("+")
    workers = os.environ.get("WORKERS", "3")
    command = [sys.executable, "-m", "pytest", "-m", "not nightly", f"--numprocesses={workers}"]
    command += ["--dist=loadfile", "--no-loadscope-reorder", *arguments]
    if "random" in parts:
        command.append(f"--shuffle={seed}")
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="stress-")))
        if "load" in parts:
            stack.enter_context(load())
        if "core" in parts:
            cores = os.sched_getaffinity(0)
            os.sched_setaffinity(0, {min(cores)})
            stack.callback(os.sched_setaffinity, 0, cores)
        command.append(f"--junitxml={folder / 'results.xml'}")
        ended = subprocess.run(command, check=False)
        failed, summary = read(folder / "results.xml")
    if ended.returncode and not failed:
        failed = [f"pytest itself: exit code {ended.returncode}"]
    return failed, summary


def read(results: Path) -> tuple[list[str], str]:
    """The names of the tests in a file of JUnit's format that failed, also in a fixture, and a summary."""
    if not results.exists():
        return [], "no results"
    cases = [
        (f"{it.get('classname')}::{it.get('name')}", {child.tag for child in it})
        for it in ET.parse(results).iter("testcase")
    ]
    failed = sorted({name for name, tags in cases if tags & {"failure", "error"}})
    skipped = sum("skipped" in tags for _, tags in cases)
    passed = len({name for name, _ in cases}) - len(failed) - skipped
    return failed, f"{len(failed)} failed, {passed} passed, {skipped} skipped"


def main(arguments: Sequence[str] | None = None) -> int:
    """The program; returns its exit code."""
    parser = argparse.ArgumentParser("tests.stress", description=__doc__.split("\n\n")[0])
    parser.add_argument("--variants", default="load,random,core", help=f"of {', '.join(PARTS)}; + combines")
    parser.add_argument("--rounds", type=int, default=1, help="runs of each variant")
    parser.add_argument("--log", type=Path, help="append a line of a table in Markdown for each run")
    parser.add_argument("files", nargs="*", help="by default the whole suite")
    options = parser.parse_args(arguments)
    variants = options.variants.split(",")
    if unknown := {part for variant in variants for part in variant.split("+")} - set(PARTS):
        parser.error(f"--variants: {', '.join(sorted(unknown))}: must be of {', '.join(PARTS)}")
    found: dict[str, list[str]] = defaultdict(list)
    for seed, variant in itertools.product(range(options.rounds), variants):
        began = time.strftime("%H:%M:%S")
        failed, summary = run(variant, seed, options.files)
        for test in failed:
            found[test].append(variant)
        row = (began, time.strftime("%H:%M:%S"), variant, f"{os.getloadavg()[2]:.1f}", summary)
        print(line := f"| {' | '.join(row)} |", flush=True)
        if options.log is not None:
            with options.log.open("a") as log:
                log.write(line + "\n")
    for test, where in sorted(found.items()):
        print(f"failed in {', '.join(where)}: {test}")
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main())
