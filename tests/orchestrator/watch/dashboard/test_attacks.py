"""No request and no content of a run folder makes the server leak or hang."""

import json
import os
import re
import select
import socket
import sqlite3
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing
from itertools import product
from pathlib import Path

import httpx
import numpy as np
import pytest
from fastapi import FastAPI

from panolog.orchestrator.runs.records import Merged, Noticed, PreviewSaved, ViewEvaluated
from panolog.orchestrator.watch.dashboard import server
from panolog.orchestrator.watch.dashboard.api import router
from panolog.orchestrator.watch.dashboard.discovery import RunEntry
from panolog.workers.tasks import COARSE, EVAL, TaskId
from tests.orchestrator.history import append
from tests.orchestrator.watch.dashboard.served import (
    EVIL,
    PATIENCE_S,
    Served,
    progressed,
    raw,
    serving,
    started,
    streaming,
    write_run,
    write_whole_run,
)

pytestmark = pytest.mark.system

SECRET = b"\xff\xd8\xffa secret outside"  # begins as a JPEG does
UP = [
    "../../secret.jpg",
    "..%2f..%2fsecret.jpg",
    "....//secret.jpg",
    "%2e%2e/%2e%2e/secret.jpg",
    "/etc/passwd",
    "..\\..\\secret.jpg",
    "\x00",
    "%00",
    "file:///etc/passwd",
    "'; DROP TABLE events; --",
    "A" * 5000,
]
MORE = ("/runs/{}", "/compare?run={}", "/static/{}", "/vendor/{}")  # besides those of the API


@pytest.fixture(scope="module")
def next_to_a_secret(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    """A server whose folder is next to a file that it must not serve."""
    root = tmp_path_factory.mktemp("root")
    (root / "secret.jpg").write_bytes(SECRET)
    write_whole_run(root / "folder" / "run")
    with serving(root / "folder") as served:
        yield served


def addresses(id: str) -> Iterator[str]:
    """Each address of the API, as often as it has parameters: one of them is {}, the others are good."""
    good = {"id": id, "task": "coarse", "run": id}
    app = FastAPI()
    app.include_router(router)
    for path, methods in app.openapi()["paths"].items():
        parameters = methods.get("get", {}).get("parameters", ())
        for wrong in (one["name"] for one in parameters):
            values = {one["name"]: good.get(one["name"], "1") for one in parameters} | {wrong: "{}"}
            query = [one["name"] for one in parameters if one["in"] == "query"]
            yield f"{path.format(**values)}?{'&'.join(f'{name}={values[name]}' for name in query)}"
    yield f"/api/compare?run={id}&run={{}}"
    yield from MORE


def test_no_parameter_leads_out_of_the_folder(next_to_a_secret: Served) -> None:
    served, id = next_to_a_secret, next_to_a_secret.id("run")
    paths = list(addresses(id))
    assert len(paths) > 40
    for path, value in product(paths, UP):
        given = value if "%" in value else httpx.URL("http://x/", params={"v": value}).query[2:].decode()
        for text in {given, value}:
            target = path.format(text).encode("latin-1")
            if re.search(rb"[\x00\s]", target):
                continue  # no request line
            answer = raw(
                served.url, b"GET %s HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n\r\n" % target
            )
            head, _, body = answer.partition(b"\r\n\r\n")
            assert re.match(rb"HTTP/1.1 (200|30\d|400|404|422) ", head), (target, head)
            assert not re.search(rb"secret outside|root:|Traceback", body), target
    assert served.get(f"/api/runs/{id}/events")["events"]  # nothing was dropped


def test_records_that_name_files_elsewhere(tmp_path: Path) -> None:
    (tmp_path / "secret.jpg").write_bytes(SECRET)
    folder = write_run(tmp_path / "folder" / "run")
    other = write_run(tmp_path / "folder" / "other")
    (other.root / "a.jpg").write_bytes(SECRET)
    (folder.root / "link.jpg").symlink_to(tmp_path / "secret.jpg")
    (folder.root / "up").symlink_to(tmp_path)
    os.mkfifo(folder.root / "pipe.jpg")
    (folder.root / "text.jpg").write_text("no picture")
    (folder.root / "a_folder.jpg").mkdir()
    paths = ["../../secret.jpg", str(tmp_path / "secret.jpg"), "link.jpg", "up/secret.jpg", "../other/a.jpg"]
    paths += ["pipe.jpg", "text.jpg", "a_folder.jpg", "", ".", "\0", "x" * 5000, "/proc/self/environ"]
    append(folder, *(PreviewSaved(COARSE, i, "v", path) for i, path in enumerate(paths)))
    views = [f"../../../../{'secret'}", "../../link", "..", ".", "", "/", "\0"]
    append(folder, *(ViewEvaluated(EVAL, view, {}) for view in views))
    with serving(tmp_path / "folder") as served:
        id = served.id("run")
        previews = served.get(f"/api/runs/{id}/previews", task="coarse")["previews"]
        assert len(previews) == len(paths)
        for preview in previews:
            assert served.errors(f"/api/runs/{id}/previews/{preview['event']}", 404)
        for view in served.get(f"/api/runs/{id}/views")["views"]:
            assert served.errors(f"/api/runs/{id}/views/{view['number']}", 404)


def test_links_out_of_a_run_are_not_followed(tmp_path: Path) -> None:
    outside = write_whole_run(tmp_path / "outside")
    for name in ("point_cloud.ply", "report.html", "partition/plan.json", "partition/scores.npz"):
        path = write_whole_run(tmp_path / "folder" / name).root / name
        path.unlink()
        path.symlink_to(outside.root / name)
    program = write_whole_run(tmp_path / "folder" / "partition" / "program")
    np.savez(program.scores, cameras=np.array([print], dtype=object), scores=np.zeros((4, 2)))
    with serving(tmp_path / "folder") as served:
        for run in served.get("/api/runs")["runs"]:
            scores = run["name"].endswith(("scores.npz", "program"))
            target = "camera/0" if scores else "map" if run["name"].startswith("partition") else run["name"]
            assert served.errors(f"/api/runs/{run['id']}/{target}", 404)


def test_files_that_are_no_files(tmp_path: Path) -> None:
    outside = write_run(tmp_path / "outside", [Noticed(None, "a secret outside")])
    outside.control.mkdir()
    make: dict[str, Callable[[Path], object]] = {
        "link": lambda path: path.symlink_to(outside.root / path.name),
        "pipe": os.mkfifo,
        "folder": Path.mkdir,
    }
    names = [
        f"{kind} {name}"
        for kind in make
        for name in ("run.db", "run.json", "lock", "run.db-journal", "control")
    ]
    for kind, _, name in (each.partition(" ") for each in names):
        path = write_run(tmp_path / "folder" / f"{kind} {name}").root / name
        path.unlink(missing_ok=True)
        make[kind](path)
    write_run(tmp_path / "folder" / "good")
    with serving(tmp_path / "folder") as served:
        rows = {row["name"]: row for row in served.get("/api/runs")["runs"]}
        assert rows["good"]["error"] is None
        for name in names:
            if name in rows and name != "folder control":
                assert rows[name]["status"] == "unreadable", name
            id = RunEntry(tmp_path / "folder", name).id
            for part in ("", "/events", "/previews", "/series?task=coarse", "/map"):
                assert "a secret outside" not in served.client.get(f"/api/runs/{id}{part}").text
            served.act(id, "stop")
    assert not list(outside.control.iterdir())


def test_a_run_that_becomes_a_link_is_gone(tmp_path: Path) -> None:
    write_run(tmp_path / "outside", [Noticed(None, "a secret outside")])
    folder = write_run(tmp_path / "folder" / "deep" / "run")
    with serving(tmp_path / "folder") as served:
        id = served.id("deep/run")
        folder.root.rename(tmp_path / "folder" / "moved")
        folder.root.symlink_to(tmp_path / "outside")
        assert "link" in served.errors(f"/api/runs/{id}", 404)
        folder.root.parent.rename(tmp_path / "folder" / "away")
        (tmp_path / "folder" / "deep").symlink_to(tmp_path / "folder" / "away")
        for path in ("", "/events", "/map"):
            assert served.errors(f"/api/runs/{id}{path}", 404)


def test_names_are_data(tmp_path: Path) -> None:
    name = EVIL.replace("/", "∕")
    folder = write_run(tmp_path / name, [Noticed(COARSE, EVIL)], scene=f"/x/{EVIL}")
    with closing(sqlite3.connect(folder.database)) as connection, connection:
        payload = json.dumps({"task": EVIL, "message": EVIL})
        connection.execute("INSERT INTO events VALUES (99, 0, ?, 'Noticed', ?)", (EVIL, payload))
    write_run(tmp_path / os.fsdecode(b"not utf-8 \xff"), [Noticed(None, "\ud800")])
    write_run(tmp_path / "line\nbreak\r\n\r\nevent: runs\ndata: {}")
    with serving(tmp_path) as served:
        answer = served.client.get("/api/runs")
        rows = answer.json()["runs"]
        assert {row["name"] for row in rows} >= {name, "not utf-8 \ufffd"}
        assert answer.headers["content-type"] == "application/json"
        assert answer.content.isascii()
        for row in rows:
            for path in ("", "/events"):
                answer = served.client.get(f"/api/runs/{row['id']}{path}")
                assert answer.status_code in (200, 404)
                assert answer.headers["x-content-type-options"] == "nosniff"
        with streaming(served) as messages:
            assert len(next(messages)[1]["runs"]) == 3


def test_a_download_has_a_plain_name(tmp_path: Path) -> None:
    folder = write_run(tmp_path / 'a"; filename="x.exe\r\nSet-Cookie: y=z')
    folder.point_cloud.write_bytes(b"ply")
    with serving(tmp_path) as served:
        (row,) = served.get("/api/runs")["runs"]
        answer = served.client.get(f"/api/runs/{row['id']}/point_cloud.ply")
    assert (
        answer.headers["content-disposition"] == 'attachment; filename="a_filename_x.exe_Set-Cookie_y_z.ply"'
    )
    assert "set-cookie" not in answer.headers


def test_numbers_that_are_none(tmp_path: Path) -> None:
    folder = write_run(tmp_path / "run", [started(COARSE), Merged("x", 1, 1, 1, 1.0)])
    with closing(sqlite3.connect(folder.database)) as connection, connection:
        payload = json.dumps(
            vars(progressed(COARSE, 5)) | {"task": "coarse", "loss": float("nan"), "psnr": float("inf")}
        )
        row = (99, 1.0, "coarse", "Progressed", payload)
        connection.execute("INSERT INTO events VALUES (?, ?, ?, ?, ?)", row)
        connection.execute("INSERT INTO metrics VALUES ('coarse', 'loss', 5, 1.0, 9e999)")
    with serving(tmp_path) as served:
        id = served.id("run")
        assert served.get(f"/api/runs/{id}")["summary"]["tasks"][0]["loss"] is None
        assert served.get(f"/api/runs/{id}/events")["events"][0]["psnr"] is None
        assert served.get(f"/api/runs/{id}/series", task="coarse")["loss"]["value"] == [None]


def test_slow_clients_delay_no_other_and_are_sent_away(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(server, "_REQUEST_TIMEOUT_S", 3600)
    write_run(tmp_path / "run")
    with serving(tmp_path) as served, ExitStack() as stack:
        host, _, port = served.url.removeprefix("http://").partition(":")

        def slow(count: int) -> list[socket.socket]:
            sockets = [socket.create_connection((host, int(port)), timeout=PATIENCE_S) for _ in range(count)]
            for number, connection in enumerate(map(stack.enter_context, sockets)):
                connection.sendall(
                    b"GET /api/runs HTTP/1.1\r\nHost: localhost\r\nX-Slow: " if number % 2 else b""
                )
            return sockets

        waiting = slow(60)
        assert served.get("/api/runs")["runs"]
        assert not select.select(waiting, [], [], 0)[0]  # answered while the slow ones still wait
        monkeypatch.setattr(server, "_REQUEST_TIMEOUT_S", 0.2)
        assert all(connection.recv(1) == b"" for connection in slow(2))


def test_a_body_that_does_not_come(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("panolog.orchestrator.watch.dashboard.dependencies._BODY_TIMEOUT_S", 0.3)
    write_run(tmp_path / "run")
    with serving(tmp_path) as served:
        head = f"POST /api/runs/{served.id('run')}/actions HTTP/1.1\r\nHost: localhost\r\nX-PanoLOG: 1\r\n"
        head += "Content-Type: application/json\r\nConnection: close\r\n"
        late = raw(served.url, f"{head}Content-Length: 50\r\n\r\n{{".encode())
        endless = raw(served.url, f"{head}Transfer-Encoding: chunked\r\n\r\n1\r\nx\r\n".encode())
    assert late.startswith(b"HTTP/1.1 408 ")
    assert endless.startswith(b"HTTP/1.1 411 ")


def test_streams_that_are_not_read(tmp_path: Path) -> None:
    """They wait by themselves: others get messages at once, and the server ends when it should."""
    folder = write_whole_run(tmp_path / "run")
    with serving(tmp_path) as served, ExitStack() as stack:
        id = served.id("run")
        host, _, port = served.url.removeprefix("http://").partition(":")
        for _ in range(100):  # more than any pool of threads has
            deaf = stack.enter_context(socket.create_connection((host, int(port))))
            deaf.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1024)
            deaf.sendall(f"GET /api/stream?run={id}&changes=1 HTTP/1.1\r\nHost: localhost\r\n\r\n".encode())
        with streaming(served, f"?run={id}&changes=1") as messages:
            next(messages)
            for iteration in range(41, 44):
                append(folder, progressed(TaskId.block(0), iteration))
                while next(messages)[0] != "events":  # fails at the client's timeout
                    pass
