"""Which runs are found, and where a dashboard listens."""

import socket
from contextlib import ExitStack
from pathlib import Path

import httpx
import pytest
from starlette.testclient import TestClient

from panolog.orchestrator.commands.companion import companion_dashboard
from panolog.orchestrator.dashboard import discovery, server
from panolog.orchestrator.dashboard.guard import Access
from panolog.orchestrator.run import lock
from panolog.orchestrator.run.records import Outcome, RunBegan, RunEnded
from panolog.scene.errors import InputError
from tests.orchestrator.cli.program import call, one_line
from tests.orchestrator.dashboard.served import Served, append, serving, streaming, write_run


def found(root: Path) -> set[str]:
    return {entry.path for entry in discovery.discover(root).values()}


def test_runs_are_found_below_the_folder(tmp_path: Path) -> None:
    for name in ("a", "b/c", "b/d/e", "1/2/3/4", "1/2/3/4/5", ".hidden/run"):
        write_run(tmp_path / name)
    write_run(tmp_path / "a" / "blocks" / "inside")
    assert found(tmp_path) == {"a", "b/c", "b/d/e", "1/2/3/4"}
    assert found(tmp_path / "a") == {"."}
    assert found(tmp_path / "nothing") == set()


def test_a_search_has_an_end(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for number in range(30):
        write_run(tmp_path / f"{number:02d}" / "run")
    monkeypatch.setattr(discovery, "_RUNS", 5)
    assert len(found(tmp_path)) == 5
    monkeypatch.setattr(discovery, "_FOLDERS", 20)
    assert found(tmp_path) == set()


def test_a_run_keeps_its_id(tmp_path: Path) -> None:
    write_run(tmp_path / "one" / "run")
    (id,) = discovery.discover(tmp_path)
    assert len(id) == 16
    assert int(id, 16)
    (tmp_path / "one").rename(tmp_path / "two")
    assert id not in discovery.discover(tmp_path)


def test_nothing_is_read_before_a_client_comes(tmp_path: Path) -> None:
    """A dashboard of many runs shows their names first."""
    for number in range(3):
        write_run(tmp_path / str(number))
    app = server.make_app(tmp_path, Access(None, 1))
    registry = app.state.registry
    registry._search()
    assert {watch.snapshot.row.status for watch in registry._watches.values()} == {"unread"}
    with TestClient(app):
        pass  # its end removes its folder


def test_a_port_that_is_taken(tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as other:
        port = other.getsockname()[1]
        with pytest.raises(InputError, match=f"127.0.0.1:{port}: cannot listen there: .*; choose another"):
            server.listen("127.0.0.1", port)
        assert "choose another --host or --port" in one_line(call("dashboard", tmp_path, "--port", port))


def test_a_folder_that_is_none(tmp_path: Path) -> None:
    assert one_line(call("dashboard", tmp_path / "nothing")).endswith("nothing: is not a folder")


def test_a_server_can_follow_itself_at_once(tmp_path: Path) -> None:
    with serving(tmp_path) as first:
        port = int(first.url.rpartition(":")[2])
        first.get("/api/runs")
    with serving(tmp_path, port=port) as second:
        second.get("/api/runs")


def test_addresses() -> None:
    with server.listen("127.0.0.1", 0) as listener:
        port = listener.getsockname()[1]
        assert server.address(listener, "127.0.0.1", None) == f"http://127.0.0.1:{port}/"
        assert server.address(listener, "::1", None) == f"http://[::1]:{port}/"
        named = server.address(listener, "0.0.0.0", "secret")
    assert named == f"http://{socket.gethostname()}:{port}/?token=secret"


def test_a_companion_dashboard_starts_before_the_run_and_ends_with_it(tmp_path: Path) -> None:
    said: list[str] = []
    with companion_dashboard(tmp_path / "run", said.append) as announcer:
        assert announcer is not None
        announcer.join(20)
        (line,) = said
        url = line.removeprefix("dashboard ")
        write_run(tmp_path / "run")
        answer = httpx.get(url.replace("/runs/", "/api/runs/"))
        assert answer.json()["name"] == "."
    with pytest.raises(httpx.ConnectError):
        httpx.get(url)


def test_a_companion_dashboard_sends_the_last_state_of_its_run_before_it_ends(tmp_path: Path) -> None:
    said: list[str] = []
    folder = write_run(tmp_path / "run", [RunBegan("host", 1, resumed=False)])
    with ExitStack() as run:
        announcer = run.enter_context(companion_dashboard(folder.root, said.append))
        assert announcer is not None
        run.enter_context(lock.hold(folder.lock))
        announcer.join(20)
        base, _, id = said[0].removeprefix("dashboard ").partition("/runs/")
        client = httpx.Client(base_url=base, timeout=20)
        with client, streaming(Served(base, client), f"?run={id}") as messages:
            assert next(messages)[1]["summary"]["status"] == "running"
            append(folder, RunEnded(Outcome.DONE))
            run.close()
            *_, last = (content for kind, content in messages if kind == "run")
    assert last["summary"]["status"] == "done"
    assert last["summary"]["eta"] is None


def test_a_dashboard_that_does_not_start_harms_no_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    said: list[str] = []
    monkeypatch.setattr("sys.executable", "/nonexistent")
    with companion_dashboard(tmp_path / "run", said.append) as announcer:
        assert announcer is None
    assert said == ["no dashboard: No such file or directory"]
