"""A run through Ray, killed and resumed, with notifications and a sink: what arrives, and no secret."""

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import psutil
import pytest

from panolog.orchestrator.run.folder import RunFolder
from panolog.orchestrator.run.records import TaskStarted
from panolog.orchestrator.run.store import read_records
from panolog.orchestrator.views.queries import series
from panolog.synthetic.make import make_town
from tests.orchestrator.follower.mail_server import mailbox
from tests.orchestrator.follower.receivers import Receiver, receiver
from tests.orchestrator.whole_runs.test_whole_runs import (
    IN_STAGE_ONE,
    SETTINGS,
    end_of,
    launch,
    wait_for_workers,
)
from tests.ray_head import wait_until

pytestmark = [pytest.mark.system, pytest.mark.nightly]

SLACK, HOOK, TOPIC = "T0PSECRETslackpath", "T0PSECRETwebhookpath", "T0PSECRETtopic"
SIGNING, TOKEN, PASSWORD = "T0PSECRETsigning", "T0PSECRETtoken", "T0PSECRETpassword"
SECRET = b"T0PSECRET"  # begins all of them


@dataclass
class Seen:
    """What an observer of a machine sees of a run."""

    commands: set[str] = field(default_factory=set)  # that have a secret
    environments: set[str] = field(default_factory=set)  # programs of Ray that have one
    files: set[str] = field(default_factory=set)  # of Ray that have one
    folders: set[str] = field(default_factory=set)  # of Ray; they go with it

    def look(self) -> None:
        for process in psutil.process_iter():
            with suppress(psutil.Error, OSError):
                words = process.cmdline()
                line = " ".join(words)
                if SECRET.decode() in line:
                    self.commands.add(line)
                if not (line.startswith("ray::") or "/raylet" in line):
                    continue
                if SECRET in Path(f"/proc/{process.pid}/environ").read_bytes():
                    self.environments.add(line[:80])
                self.folders |= {it.partition("=")[2] for it in words if it.startswith("--temp_dir=")}
        for folder in self.folders:
            self.files |= set(files_with_secrets(Path(folder), 0.0))


@contextmanager
def observed() -> Iterator[Seen]:
    """Looks at all processes, and at the files of Ray, while the context lasts."""
    ended, seen = threading.Event(), Seen()

    def watch() -> None:
        while not ended.wait(0.3):
            seen.look()

    watcher = threading.Thread(target=watch)
    watcher.start()
    try:
        yield seen
    finally:
        ended.set()
        watcher.join()


def files_with_secrets(folder: Path, since: float) -> list[str]:
    """Files below a folder that have changed since then and have a secret in them."""
    found = []
    for path in folder.rglob("*"):
        with suppress(OSError):
            if path.is_file() and path.stat().st_mtime >= since and SECRET in path.read_bytes():
                found.append(str(path))
    return found


def options(folder: Path, server: Receiver, mail: int, environment: pytest.MonkeyPatch) -> list[str]:
    """Targets of every kind, each with its secret in another place."""
    secret = folder / "secret"
    secret.write_text(SIGNING)
    hook = folder / "hook"
    hook.write_text(f"{server.url}/{HOOK}")
    for file in (secret, hook):
        file.chmod(0o600)
    environment.setenv("SLACK_URL", f"{server.url}/{SLACK}")
    environment.setenv("PANOLOG_NOTIFY", f"ntfy:{server.url}/{TOPIC}")
    environment.setenv("PANOLOG_NOTIFY_SECRET", f"@{secret}")
    environment.setenv("PANOLOG_NTFY_TOKEN", TOKEN)
    environment.setenv("PANOLOG_SMTP_USER", "me@there")
    environment.setenv("PANOLOG_SMTP_PASSWORD", PASSWORD)
    targets = ["slack:env:SLACK_URL", f"webhook:@{hook}", f"mail:smtp://127.0.0.1:{mail}/you@there"]
    return [word for target in targets for word in ("--notify", target)]


def test_a_run_that_is_killed_and_resumed_notifies_and_shows_no_secret(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    began, board, root = time.time(), tmp_path / "board", tmp_path / "run"
    keys = tmp_path / "keys"
    keys.mkdir()
    scene = make_town(tmp_path / "town", panoramas=9, width=64, points=300)
    monkeypatch.setenv("PANOLOG_LOG", "DEBUG")
    with receiver() as server, mailbox() as box, observed() as seen:
        more = options(keys, server, box.port, monkeypatch)
        try:
            import tensorboard  # noqa: F401, PLC0415

            more += ["--log", f"tensorboard:{board}"]
        except ImportError:
            pass  # the rest holds without it
        first = end_of(launch("run", scene, "-o", root, *SETTINGS, *more, accidents=IN_STAGE_ONE))
        assert first.code == -9, first.stderr
        wait_for_workers(root)
        wait_until(lambda: len(server.received) >= 3, "the messages of the killed driver", 300)
        second = end_of(launch("resume", root, *more))
        assert second.code == 0, second.stderr
        events = end_of(launch("events", root))
        status = end_of(launch("status", root, "--json"))
    kinds = [it.json["type"] for it in server.received if it.path == f"/{HOOK}"]
    assert kinds == ["run.failed", "run.done"]
    assert sorted(it.path for it in server.received) == sorted([f"/{HOOK}", f"/{SLACK}", "/"] * 2)
    assert len(box.messages) == len(box.logins) == 2
    assert all("webhook-signature" in it.headers for it in server.received if it.path == f"/{HOOK}")
    assert seen.folders
    assert (seen.commands, seen.environments, seen.files) == (set(), set(), set())
    said = "".join(end.stdout + end.stderr for end in (first, second, events, status))
    assert SECRET.decode() not in said
    assert "not delivered" not in second.stderr
    assert "not all was passed on" not in second.stderr
    for path in keys.iterdir():
        path.unlink()
    assert files_with_secrets(tmp_path, began) == []
    if board.exists():
        check_curves(root, board)


def check_curves(root: Path, board: Path) -> None:
    """TensorBoard has each curve of run.db, and nothing else."""
    from tensorboard.backend.event_processing.event_multiplexer import EventMultiplexer  # noqa: PLC0415

    reader = EventMultiplexer(size_guidance={"scalars": 0}).AddRunsFromDirectory(str(board)).Reload()
    found = {
        (run, tag): [(it.step, it.value) for it in reader.Scalars(run, tag)]
        for run, tags in reader.Runs().items()
        for tag in tags["scalars"]
        if not tag.startswith("final/")
    }
    database = RunFolder(root).database
    tasks = {
        str(s.record.task) for s in read_records(database, limit=10**6) if isinstance(s.record, TaskStarted)
    }
    expected = {}
    for task in tasks:
        for name, curve in series(database, task, 10**6).items():
            values = [float(np.float32(value)) for value in curve["value"]]
            expected[task, name] = list(zip(map(int, curve["iteration"]), values, strict=True))
    assert found == expected
    assert ("coarse", "loss") in found
    assert {tag for _, tag in found} >= {"loss", "gaussians", "rate"}
