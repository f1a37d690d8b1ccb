"""Which requests the dashboard accepts, which runs it finds, and where it listens."""

import socket
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import httpx
import pytest

from panolog.orchestrator.cli.session.companion import companion_dashboard
from panolog.orchestrator.runs import control, lock
from panolog.orchestrator.runs.folder import RunFolder
from panolog.orchestrator.runs.records import Outcome, RunBegan, RunEnded
from panolog.orchestrator.watch.dashboard import discovery, guard
from panolog.orchestrator.watch.dashboard.discovery import RunEntry
from panolog.scene.errors import InputError
from tests.orchestrator.cli.program import call, one_line
from tests.orchestrator.history import append
from tests.orchestrator.watch.dashboard.served import (
    PATIENCE_S,
    POST,
    Served,
    raw,
    serving,
    streaming,
    write_run,
    write_whole_run,
)

TOKEN = "t" * 43


@pytest.fixture(scope="module")
def driven(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Served, RunFolder]]:
    """A run whose lock is held as by a driver, for tests that leave no request behind."""
    root = tmp_path_factory.mktemp("driven")
    folder = write_whole_run(root / "run")
    folder.control.mkdir()
    with serving(root) as served, lock.hold(folder.lock):
        yield served, folder


@pytest.mark.parametrize(
    "host", ["evil.example", "evil.example:80", "127.0.0.1.evil.example", "", "[::2]", "localhost.evil"]
)
def test_another_name_for_this_machine_is_refused(served: Served, host: str) -> None:
    answer = raw(served.url, f"GET /api/runs HTTP/1.1\r\nHost: {host}\r\nConnection: close\r\n\r\n".encode())
    assert answer.startswith(b"HTTP/1.1 403 ")
    assert b"run" not in answer.partition(b"\r\n\r\n")[2].replace(b"runs", b"")


def test_this_machine_may_be_called(served: Served) -> None:
    for host in ("localhost", "LOCALHOST:99", "127.0.0.1:8360", "[::1]:8360", "[::1]"):
        assert served.client.get("/api/runs", headers={"Host": host}).status_code == 200


@pytest.mark.parametrize(
    "headers",
    [
        {"X-PanoLOG": ""},
        {"Content-Type": "text/plain"},
        {"Content-Type": "application/x-www-form-urlencoded"},
        {"Origin": "http://evil.example"},
        {"Origin": "null"},
        {"Origin": "http://localhost:1"},
        {"Origin": "http://["},
        {"Sec-Fetch-Site": "cross-site"},
        {"Sec-Fetch-Site": "same-site"},
        {"Host": "evil.example"},
    ],
)
def test_other_sites_cannot_act(driven: tuple[Served, RunFolder], headers: dict[str, str]) -> None:
    served, folder = driven
    path = f"/api/runs/{served.id('run')}/actions"
    for target in (path, path.replace("actions", "viewer"), "/api/queue"):
        answer = served.client.post(target, content='{"action": "stop"}', headers=POST | headers)
        assert answer.status_code == 403
    assert control.take(folder) == []
    ours = {"Origin": served.url, "Sec-Fetch-Site": "same-origin"}
    assert served.client.post(path, content='{"action": "stop"}', headers=POST | ours).status_code == 202
    assert [str(request) for request in control.take(folder)] == ["stop"]


@pytest.mark.parametrize(
    ("body", "status"),
    [
        ("", 422),
        ("[]", 422),
        ('{"action": "rm"}', 422),
        ('{"action": "stop", "x": 1}', 422),
        ('{"action": "pause", "block": "0"}', 422),
        ('{"action": "pause", "block": 99999999999999999999999}', 409),
        ('{"action": "pause", "block": 7}', 409),
        ('{"action": "unpause", "block": 0}', 409),
        ('{"action": "stop", "block": 0}', 409),
        ('{"action": "release"}', 409),
        ('{"action": "release", "node": 7}', 422),
        ('{"action": "release", "node": "gpu-07"}', 409),
        ("[" * 4000, 422),
        ("x" * 5000, 413),
    ],
)
def test_nonsense_is_refused(driven: tuple[Served, RunFolder], body: str, status: int) -> None:
    served, folder = driven
    answer = served.client.post(f"/api/runs/{served.id('run')}/actions", content=body, headers=POST)
    assert answer.status_code == status, answer.text
    assert "\n" not in answer.json()["error"]
    assert control.take(folder) == []


def test_other_methods_do_nothing(served: Served) -> None:
    for method in ("PUT", "DELETE", "PATCH", "OPTIONS", "TRACE"):
        answer = served.client.request(method, f"/api/runs/{served.id('run')}", headers=POST)
        assert answer.status_code in (403, 405)
        assert "access-control-allow-origin" not in answer.headers


def test_the_token_opens_the_door_and_without_it_nothing_is_answered(tmp_path: Path) -> None:
    write_whole_run(tmp_path / "run")
    id = RunEntry(tmp_path, "run").id
    with serving(tmp_path, token=TOKEN) as served:
        targets = ["/", f"/runs/{id}", "/static/runs/runs.js", "/vendor/plotly.min.js"]
        targets += ["/api/runs", "/api/stream", "/compare", "/api/compare", "/api/compare/curves"]
        targets += [f"/api/runs/{id}{rest}" for rest in ("", "/map", "/point_cloud.ply", "/nothing")]
        wrong: list[dict[str, Any]] = [
            {},
            {"params": {"token": "wrong"}},
            {"params": {"token": ""}},
            {"params": {"token": TOKEN[:-1]}},
            {"headers": {"Authorization": "Bearer wrong"}},
            {"headers": {"Authorization": TOKEN}},
            {"headers": {"Cookie": "panolog-1=wrong"}},
            {"headers": {"Cookie": f"panolog={TOKEN}"}},
            {"headers": {"Authorization": "Bearer \xff".encode("latin-1")}},
        ]
        for target in targets:
            for given in wrong:
                answer = served.client.get(target, **given)
                assert answer.status_code == 403, (target, given)
                assert set(answer.json()) == {"error"}
        answer = served.client.get("/api/runs", params={"token": TOKEN})
        assert answer.status_code == 403  # only the first page takes it
        answer = served.client.post(f"/api/runs/{id}/actions", content="{}", headers=POST)
        assert answer.status_code == 403
        bearer = {"Authorization": f"Bearer {TOKEN}", "Host": "any.name"}
        assert served.client.get("/api/runs", headers=bearer).status_code == 200
        door = served.client.get("/", params={"token": TOKEN})
        cookie = door.headers["set-cookie"]
        assert {"HttpOnly", "SameSite=strict", "Path=/"} <= set(cookie.split("; "))
        assert 'http-equiv="refresh" content="0;url=./"' in door.text
        assert TOKEN not in door.text
        assert served.act(id, "stop").status_code == 409  # the client has the cookie now
        served.client.headers["Origin"] = "http://evil.example"
        assert served.act(id, "stop").status_code == 403


def test_a_token_is_needed_beyond_this_machine_and_stays_the_same(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    file = guard.token_file()
    for host in ("127.0.0.1", "127.1.2.3", "::1", "localhost"):
        assert guard.token_for(host) is None
    assert not file.exists()
    token = guard.token_for("0.0.0.0")
    assert token is not None and len(token) >= 43
    assert file.stat().st_mode & 0o777 == 0o600
    assert {guard.token_for(host) for host in ("::", "192.168.1.1", "myhost")} == {token}


def test_without_a_home_only_the_token_is_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    """As in a container whose user has no entry: Path.home() raises RuntimeError."""
    monkeypatch.delenv("XDG_STATE_HOME", raising=False)
    monkeypatch.setattr(Path, "home", lambda: (_ for _ in ()).throw(RuntimeError("no home")))
    assert guard.token_for("127.0.0.1") is None
    with pytest.raises(InputError, match="set HOME or XDG_STATE_HOME"):
        guard.token_for("0.0.0.0")


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
            guard.listen("127.0.0.1", port)
        assert "choose another --host or --port" in one_line(call("dashboard", tmp_path, "--port", port))
    assert one_line(call("dashboard", tmp_path / "nothing")).endswith("nothing: is not a folder")


def test_addresses() -> None:
    with guard.listen("127.0.0.1", 0) as listener:
        port = listener.getsockname()[1]
        assert guard.address(listener, "127.0.0.1", None) == f"http://127.0.0.1:{port}/"
        assert guard.address(listener, "::1", None) == f"http://[::1]:{port}/"
        named = guard.address(listener, "0.0.0.0", "secret")
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
