"""`make stress`: the suite under load, in random order and on one core, and what has failed at least once.

    python -m tests.stress [--variants load,random,core] [--rounds N] [FILE ...]

A variant is `idle`, `load` (busy processes, memory that is written and files that are flushed), `random`
(another order in each round) or `core` (all processes on one core), or several of them with `+`. The exit
code is 1 if anything has failed.
"""

import argparse
import itertools
import os
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from multiprocessing import get_context

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


def run(variant: str, seed: int, arguments: Sequence[str]) -> list[str]:
    """Runs the tests once. Returns the names of those that failed, also in a fixture."""
    parts, failed = variant.split("+"), list[str]()
    workers = os.environ.get("WORKERS", "6")
    command = [sys.executable, "-m", "pytest", "-m", "not nightly", f"--numprocesses={workers}"]
    command += ["--dist=loadfile", "--no-loadscope-reorder", *arguments]
    if "random" in parts:
        command.append(f"--shuffle={seed}")
    with ExitStack() as stack:
        if "load" in parts:
            stack.enter_context(load())
        if "core" in parts:
            cores = os.sched_getaffinity(0)
            os.sched_setaffinity(0, {min(cores)})
            stack.callback(os.sched_setaffinity, 0, cores)
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
            for line in process.stdout or ():
                print(line, end="", flush=True)
                if line.startswith(("FAILED ", "ERROR ")):
                    failed.append(line.split(" - ")[0].strip())
    return failed or [f"pytest itself: exit code {process.returncode}"] * bool(process.returncode)


def main(arguments: Sequence[str] | None = None) -> int:
    """The program; returns its exit code."""
    parser = argparse.ArgumentParser("tests.stress", description=__doc__.split("\n\n")[0])
    parser.add_argument("--variants", default="load,random,core", help=f"of {', '.join(PARTS)}; + combines")
    parser.add_argument("--rounds", type=int, default=1, help="runs of each variant")
    parser.add_argument("files", nargs="*", help="by default the whole suite")
    options = parser.parse_args(arguments)
    variants = options.variants.split(",")
    if unknown := {part for variant in variants for part in variant.split("+")} - set(PARTS):
        parser.error(f"--variants: {', '.join(sorted(unknown))}: must be of {', '.join(PARTS)}")
    found: dict[str, list[str]] = defaultdict(list)
    for seed, variant in itertools.product(range(options.rounds), variants):
        for test in run(variant, seed, options.files):
            found[test].append(variant)
    for test, where in sorted(found.items()):
        print(f"in {', '.join(where)}: {test}")
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main())
