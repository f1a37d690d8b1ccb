"""A queue of stand-ins, and a runner of it as a process of its own that may be killed."""

import json
import os
import signal
import subprocess
import sys
from contextlib import closing, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from panolog.orchestrator.runs.queue.database import Queue
from panolog.orchestrator.runs.queue.entries import Command, Entry, Needs, State
from tests.ray_head import wait_until

ANY = Needs()  # an even part
STAND_IN = Path(__file__).with_name("stand_in.py")
RUNNER = """
import signal, sys
from pathlib import Path
from panolog.orchestrator.runs.queue import processes
from panolog.orchestrator.runs.queue.runner import Limits, run_queue, sole_runner
from panolog.orchestrator.runs.queue.database import opened

signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background jobs ignore it
folder, boot, at_once, forever, *program = sys.argv[1:]
processes.BOOT = Path(boot)
limits = Limits(int(at_once), bool(int(forever)), tuple(program))
with opened(Path(folder)) as queue, sole_runner(Path(folder)):
    sys.exit(run_queue(queue, limits, lambda line: print(line, flush=True)))
"""


@dataclass
class Scripted:
    """A queue whose runs are stand-ins, on a machine that can seem to start anew."""

    root: Path
    at_once: int = 1
    forever: bool = False
    boots: int = 0

    @property
    def folder(self) -> Path:
        return self.root / "queue"

    @property
    def log(self) -> Path:
        return self.root / "log"

    def add(self, name: str, scene: str = "scene", needs: Needs | None = ANY, *, held: bool = False) -> int:
        """Adds a run. Args: held, it works until its file `wait` is removed."""
        run = self.root / name
        if held:
            run.mkdir()
            (run / "wait").touch()
        with closing(Queue(self.folder)) as queue:
            return queue.add(Command(run, (scene, "--output", str(run)), (), self.root, needs))

    def share(self, name: str) -> dict[str, Any]:
        """What a run has seen of the machine; {} before it has begun."""
        path = self.root / name / "share"
        found: dict[str, Any] = json.loads(path.read_text() or "{}") if path.exists() else {}
        return found

    def entries(self) -> list[Entry]:
        with closing(Queue(self.folder)) as queue:
            return queue.entries(removed=True)

    def states(self) -> list[State]:
        return [entry.state for entry in self.entries()]

    def lines(self) -> list[list[str]]:
        """The log: word, run, process."""
        return [line.split() for line in self.log.read_text().splitlines()] if self.log.exists() else []

    def start(self) -> "subprocess.Popen[str]":
        boot = self.root / "boot_id"
        boot.write_text(f"boot-{self.boots}\n")
        program = (sys.executable, "-S", str(STAND_IN), str(self.log))
        options = (str(self.folder), str(boot), str(self.at_once), str(int(self.forever)))
        return subprocess.Popen(
            [sys.executable, "-c", RUNNER, *options, *program],
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            start_new_session=True,
        )

    def reboot(self, runner: "subprocess.Popen[str]") -> None:
        """Ends everything at once; the machine is another one afterwards."""
        runner.kill()
        pids = {
            entry.process.pid for entry in self.entries() if entry.process and entry.state == State.RUNNING
        }
        pids |= {int(pid) for word, _, pid in self.lines() if word in ("begins", "resumes")}
        ended = {int(pid) for word, _, pid in self.lines() if word in ("done", "stops", "locked-out")}
        for pid in pids - ended:
            if _is_stand_in(pid):
                with suppress(ProcessLookupError):
                    os.kill(pid, signal.SIGKILL)
        runner.wait()
        wait_until(lambda: not any(map(_is_stand_in, pids - ended)), "the end of all processes")
        self.boots += 1


def _is_stand_in(pid: int) -> bool:
    """Whether the number is still that of a stand-in, or of one at the gate."""
    try:
        return str(STAND_IN).encode() in Path(f"/proc/{pid}/cmdline").read_bytes()
    except (FileNotFoundError, ProcessLookupError):
        return False
