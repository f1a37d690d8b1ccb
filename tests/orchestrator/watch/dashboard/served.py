"""Run folders as drivers leave them, and a real server of them."""

import json
import socket
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from threading import Thread
from typing import Any

import cv2
import httpx
import numpy as np
from scipy.sparse import csr_array

from panolog.orchestrator.engine.stages.partitioning import plan_records, write_plan
from panolog.orchestrator.runs.folder import RunFolder
from panolog.orchestrator.runs.records import (
    CheckpointSaved,
    Merged,
    ModelSaved,
    Noticed,
    PreflightSaved,
    PreviewSaved,
    Progressed,
    Record,
    RunBegan,
    TaskStarted,
    ViewEvaluated,
)
from panolog.orchestrator.watch.dashboard import guard, server
from panolog.partition.cells import Grid
from panolog.partition.plan import PartitionConfig, Plan, make_plan
from panolog.workers.tasks import COARSE, EVAL, TaskId
from tests.orchestrator.history import append, begun

PATIENCE_S = 120.0  # for what a machine under load does at last
POST = {"X-PanoLOG": "1", "Content-Type": "application/json"}
SCORES = csr_array([[1.0, 0], [1, 0.9], [0.1, 1], [0, 1]])  # of the cameras and blocks of `plan`
EVIL = '<script>alert("x")</script>&\'"'


def write_run(root: Path, records: Sequence[Record] = (), scene: str = "/scenes/town") -> RunFolder:
    """A run folder with that history."""
    folder = begun(root, scene=scene, iterations=100)
    append(folder, *records)
    return folder


def started(task: TaskId, iteration: int = 0) -> TaskStarted:
    """A task's beginning."""
    return TaskStarted(task, 1, iteration, socket.gethostname(), 7, "cpu", 2, "cpu")


def progressed(task: TaskId, iteration: int, gaussians: int = 500) -> Progressed:
    """A task's progress."""
    return Progressed(task, iteration, 100, 4.0, 0.1, 21.0, gaussians, 1_000_000, 2_000_000, {"means": 1e-4})


def plan() -> Plan:
    """Four cameras in two blocks."""
    centers = np.array([[-3.0, 0, 0], [-1, 0.5, 0], [1, 0, 0.2], [3, 0.4, 0]])
    means = np.random.default_rng(0).uniform(-4, 4, (50, 3))
    names = [f"{number}.jpg" for number in range(4)]
    return make_plan(centers, means, SCORES, Grid((2, 1, 1)), PartitionConfig(), rows=range(4), names=names)


def write_whole_run(root: Path, scene: str = "/scenes/town") -> RunFolder:
    """A run in the middle of Stage II, with all that a page shows."""
    folder = write_run(root, scene=scene)
    write_plan(folder, plan(), SCORES)
    for path in (folder.root / "coarse" / "previews" / "000050.jpg", folder.images / "a" / "0.jpg"):
        path.parent.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(path), np.zeros((16, 16, 3), np.uint8))
    folder.point_cloud.write_bytes(b"ply\n")
    folder.report.write_text("<script>1</script>")
    append(
        folder,
        RunBegan(socket.gethostname(), 1, resumed=False),
        PreflightSaved("preflight.json", {"coarse": 60.0, "block": 90.0, "merge": 1.0, "eval": 5.0}),
        started(COARSE),
        progressed(COARSE, 50),
        PreviewSaved(COARSE, 50, "1.jpg", "coarse/previews/000050.jpg"),
        Noticed(COARSE, "an image is strange"),
        ModelSaved(COARSE, "coarse/model.ply", 500, 9_000, 100, 12.0),
        *plan_records(folder, plan(), SCORES),
        started(TaskId.block(0)),
        *(progressed(TaskId.block(0), iteration) for iteration in range(1, 41)),
        CheckpointSaved(TaskId.block(0), 40, "blocks/000/checkpoint.safetensors", 10),
        ViewEvaluated(EVAL, "a/0.png", {"psnr": 20.0}),
        Merged("point_cloud.ply", 500, 10, 4, 1.0),
    )
    return folder


@dataclass
class Served:
    """A server at work."""

    url: str
    client: httpx.Client

    def get(self, path: str, **parameters: Any) -> Any:
        """The JSON of an answer that must be good."""
        answer = self.client.get(path, params=parameters)
        assert answer.status_code == 200, answer.text
        return answer.json()

    def id(self, name: str = ".") -> str:
        """The id of a run."""
        (found,) = (run["id"] for run in self.get("/api/runs")["runs"] if run["name"] == name)
        return str(found)

    def errors(self, path: str, status: int, **parameters: Any) -> str:
        """The line of an answer that must be that refusal."""
        answer = self.client.get(path, params=parameters)
        assert answer.status_code == status, answer.text
        return str(answer.json()["error"])

    def act(self, id: str, action: str, block: int | None = None) -> httpx.Response:
        """Sends the request of a page."""
        body = json.dumps({"action": action, "block": block})
        return self.client.post(f"/api/runs/{id}/actions", content=body, headers=POST)


@contextmanager
def serving(
    root: Path, *, token: str | None = None, port: int = 0, queue: Path | None = None
) -> Iterator[Served]:
    """A server in a thread while the context lasts."""
    listener = guard.listen("127.0.0.1", port)
    running = server.make_server(root, listener, token, queue)
    thread = Thread(target=running.run, kwargs={"sockets": [listener]})
    thread.start()
    url = f"http://127.0.0.1:{listener.getsockname()[1]}"
    try:
        with httpx.Client(base_url=url, timeout=PATIENCE_S) as client:
            yield Served(url, client)
    finally:
        running.should_exit = True
        thread.join(PATIENCE_S)
        assert not thread.is_alive()


@contextmanager
def streaming(served: Served, query: str = "") -> Iterator[Iterator[tuple[str, Any]]]:
    """The messages of a stream as (event, content); pings are left out."""
    with served.client.stream("GET", f"/api/stream{query}") as answer:
        assert answer.status_code == 200

        def messages() -> Iterator[tuple[str, Any]]:
            event = ""
            for line in answer.iter_lines():
                if line.startswith("event: "):
                    event = line.removeprefix("event: ")
                elif line.startswith("data: "):
                    yield event, json.loads(line.removeprefix("data: "))

        yield messages()


def raw(url: str, request: bytes) -> bytes:
    """What comes back for bytes that no client library would send."""
    host, _, port = url.removeprefix("http://").partition(":")
    with socket.create_connection((host, int(port)), timeout=PATIENCE_S) as connection:
        connection.sendall(request)
        answer = b""
        while part := connection.recv(65_536):
            answer += part
    return answer
