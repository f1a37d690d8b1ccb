"""Which runs are found, and where a dashboard listens."""

import socket
from contextlib import ExitStack
from pathlib import Path

import httpx
import pytest

from panolog.orchestrator.cli.session.companion import companion_dashboard
from panolog.orchestrator.runs import lock
from panolog.orchestrator.runs.records import Outcome, RunBegan, RunEnded
from panolog.orchestrator.watch.dashboard import discovery, server
from panolog.scene.errors import InputError
from tests.orchestrator.cli.program import call, one_line
from tests.orchestrator.watch.dashboard.served import PATIENCE_S, Served, append, streaming, write_run


def found(root: Path) -> set[str]:
    return {entry.path for entry in discovery.discover(root).values()}


def test_runs_are_found_below_the_folder(tmp_path: Path) -> None:
    write_run(tmp_path / "outside")
    root = tmp_path / "folder"
    for name in ("a", "b/c", "b/d/e", "1/2/3/4", "1/2/3/4/5", ".hidden/run"):
        write_run(root / name)
    write_run(root / "a" / "blocks" / "inside")
    (root / "link").symlink_to(tmp_path / "outside")
    (root / "loop").symlink_to(root)
    assert found(root) == {"a", "b/c", "b/d/e", "1/2/3/4"}
    assert found(root / "a") == {"."}
    assert found(root / "nothing") == set()


def test_a_search_has_an_end(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for number in range(30):
        write_run(tmp_path / f"{number:02d}" / "run")
    monkeypatch.setattr(discovery, "_RUNS", 5)
    assert len(found(tmp_path)) == 5
    monkeypatch.setattr(discovery, "_FOLDERS", 20)
    assert found(tmp_path) == set()


def test_a_port_that_is_taken_and_a_folder_that_is_none(tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as other:
        port = other.getsockname()[1]
        with pytest.raises(InputError, match=f"127.0.0.1:{port}: cannot listen there: .*; choose another"):
            server.listen("127.0.0.1", port)
        assert "choose another --host or --port" in one_line(call("dashboard", tmp_path, "--port", port))
    assert one_line(call("dashboard", tmp_path / "nothing")).endswith("nothing: is not a folder")


def test_addresses() -> None:
    with server.listen("127.0.0.1", 0) as listener:
        port = listener.getsockname()[1]
        assert server.address(listener, "127.0.0.1", None) == f"http://127.0.0.1:{port}/"
        assert server.address(listener, "::1", None) == f"http://[::1]:{port}/"
        named = server.address(listener, "0.0.0.0", "secret")
    assert named == f"http://{socket.gethostname()}:{port}/?token=secret"


def test_a_companion_dashboard_starts_before_its_run_and_ends_after_it(tmp_path: Path) -> None:
    """The last that it sends is how the run has ended."""
    said: list[str] = []
    with ExitStack() as run:
        announcer = run.enter_context(companion_dashboard(tmp_path / "run", said.append))
        assert announcer is not None
        announcer.join(PATIENCE_S)
        folder = write_run(tmp_path / "run", [RunBegan("host", 1, resumed=False)])
        run.enter_context(lock.hold(folder.lock))
        base, _, id = said[0].removeprefix("dashboard ").partition("/runs/")
        client = httpx.Client(base_url=base, timeout=PATIENCE_S)
        with client, streaming(Served(base, client), f"?run={id}") as messages:
            assert next(messages)[1]["summary"]["status"] == "running"
            append(folder, RunEnded(Outcome.DONE))
            run.close()
            *_, last = (content for kind, content in messages if kind == "run")
    assert (last["summary"]["status"], last["summary"]["eta"]) == ("done", None)
    with pytest.raises(httpx.ConnectError):
        httpx.get(base)


def test_a_dashboard_that_does_not_start_harms_no_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    said: list[str] = []
    monkeypatch.setattr("sys.executable", "/nonexistent")
    with companion_dashboard(tmp_path / "run", said.append) as announcer:
        assert announcer is None
    assert said == ["no dashboard: No such file or directory"]
