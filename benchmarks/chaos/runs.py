"""Runs of one scene on one cluster, with faults as planned."""

import hashlib
import subprocess
import sys
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from math import inf
from pathlib import Path
from shutil import rmtree

import psutil

from benchmarks.chaos import faults
from benchmarks.chaos.cluster import DRIVER, LocalCluster
from benchmarks.chaos.faults import HELLO_S, QUARANTINE, RETRY_S, SILENCE_S, Planned, Undo, Victim
from panolog.orchestrator.runs.folder import RunFolder
from panolog.synthetic.make import make_town

SETTINGS = (
    *("--device", "cpu", "--blocks", "2x2x1", "--iterations", "200", "--width", "128"),
    *("--set", "sky.count=500", "--set", "preview.every=100"),
    *("--set", "checkpoint.every=50", "--set", "checkpoint.share=1"),
    *("--set", f"deadlines.message={SILENCE_S}", "--set", f"deadlines.hello={HELLO_S}"),
    *("--set", f"quarantine.failures={QUARANTINE}", "--set", f"disk.retry={RETRY_S}"),
)
_TIMEOUT_S = 3600.0  # for a run, also on a busy machine
_POLL_S = 0.1  # between two looks at the run


@dataclass(frozen=True)
class Fault:
    """One that was caused."""

    at: float  # seconds since the beginning of the run
    planned: Planned


@dataclass(frozen=True)
class Run:
    """One run and its faults."""

    number: int  # 0 is the undisturbed one
    seconds: float
    faults: tuple[Fault, ...]
    digest: str  # of the PLY; empty if the run failed
    end: str  # error of the run; empty if it did not fail


@dataclass
class _Causing:
    """The faults of a run at work."""

    plan: list[Planned]  # that are still to come
    began: float
    caused: list[Fault] = field(default_factory=list)
    lasting: list[tuple[float, Undo]] = field(default_factory=list)  # when each is to end, and how

    def step(self, victim: Victim) -> None:
        """Causes what is due, unless there is nothing to hit yet, and ends what has lasted long enough."""
        now = time.time()
        due = self.plan and self.began + self.plan[0].after <= now
        if due and (undo := faults.cause(self.plan[0], victim)):
            planned, now = self.plan.pop(0), time.time()
            self.caused.append(Fault(now - self.began, planned))
            self.lasting.append((now + (planned.lasts or inf), undo))
        for ending in [it for it in self.lasting if it[0] <= now]:
            self.lasting.remove(ending)
            ending[1]()

    def end(self) -> None:
        """Ends all faults."""
        for _, undo in self.lasting:
            undo()


class ChaosRuns:
    """Runs of one scene on one cluster, in the folder `root`."""

    def __init__(self, cluster: LocalCluster, root: Path) -> None:
        self._cluster = cluster
        self._root = root
        self._scene = make_town(root / "town", panoramas=12, width=128, points=1000)

    def run(self, number: int, plan: Sequence[Planned]) -> Run:
        """A whole run, with faults in the order of the plan."""
        folder = self.folder(number)
        self._cluster.wait()
        began = time.time()
        causing = _Causing(list(plan), began)
        try:
            end = self._attend(causing, folder)
        finally:
            causing.end()
        seconds = time.time() - began
        digest = "" if end else hashlib.sha256(RunFolder(folder).point_cloud.read_bytes()).hexdigest()
        return Run(number, seconds, tuple(causing.caused), digest, end)

    def disturbed(self, number: int, plan: Sequence[Planned]) -> Run:
        """A run with at least one fault: one that ended before the first is repeated with earlier ones."""
        while not (run := self.run(number, plan)).faults and not run.end:
            for folder in (self.folder(number), self._store(self.folder(number))):
                rmtree(folder)
            plan = [replace(planned, after=planned.after / 2) for planned in plan]
        return run

    def folder(self, number: int) -> Path:
        """The folder of a run."""
        return self._root / f"run-{number:03d}"

    def _store(self, folder: Path) -> Path:
        return self._root / "store" / folder.name

    def _launch(self, folder: Path) -> tuple[subprocess.Popen[bytes], subprocess.Popen[bytes]]:
        """The supervisor of a run, and what writes its output to a log."""
        command = [sys.executable, "-m", "panolog.orchestrator.cli", "run", str(self._scene), *SETTINGS]
        command += ["-o", f"file://{self._store(folder)}", "--local", str(folder)]
        command += ["--supervise", "--address", self._cluster.address]
        with (self._root / f"{folder.name}.log").open("ab") as log:
            terminal = subprocess.Popen("cat", stdin=subprocess.PIPE, stdout=log)
        assert terminal.stdin is not None
        with terminal.stdin as output:
            supervisor = subprocess.Popen(
                command,
                env=self._cluster.environment(DRIVER),
                stdout=output,
                stderr=output,
                stdin=subprocess.DEVNULL,
            )
        return supervisor, terminal

    def _attend(self, causing: _Causing, folder: Path) -> str:
        """A run to its end. Returns its error, empty if it ended well."""
        supervisor, terminal = self._launch(folder)
        try:
            return self._watch(supervisor, terminal, causing, folder)
        finally:
            _end(supervisor)
            terminal.wait()

    def _watch(
        self,
        supervisor: subprocess.Popen[bytes],
        terminal: subprocess.Popen[bytes],
        causing: _Causing,
        folder: Path,
    ) -> str:
        """Until the run has ended. Returns its error, empty if it ended well."""
        while time.time() < causing.began + _TIMEOUT_S:
            try:
                code = supervisor.wait(_POLL_S)
            except subprocess.TimeoutExpired:
                self._cluster.keep()
                children = _children(supervisor)
                store = self._store(folder)
                victim = Victim(self._cluster, self._scene, folder, store, *children, terminal)
                causing.step(victim)
                continue
            if not code:
                return ""
            lines = (self._root / f"{folder.name}.log").read_text().strip().splitlines()
            return f"exit code {code}: {lines[-1] if lines else 'no output'}"
        return f"no end after {_TIMEOUT_S:.0f} s"


def _children(supervisor: subprocess.Popen[bytes]) -> tuple[psutil.Process | None, psutil.Process | None]:
    """The driver that a supervisor has started, and its mirror; None between two."""
    found: dict[bool, psutil.Process] = {}
    with suppress(psutil.Error):
        for child in psutil.Process(supervisor.pid).children():
            found.setdefault("panolog.orchestrator.runs.storage" in child.cmdline(), child)
    return found.get(False), found.get(True)


def _end(supervisor: subprocess.Popen[bytes]) -> None:
    """Ends a run that would not end."""
    if supervisor.poll() is None:
        process = psutil.Process(supervisor.pid)
        for one in (process, *process.children(recursive=True)):
            one.kill()
        supervisor.wait()
