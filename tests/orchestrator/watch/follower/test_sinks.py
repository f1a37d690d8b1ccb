"""What sinks have in the end is what run.db has, however often the follower and the run were killed.

The packages `wandb` and `mlflow`, which has the server, are installed by `make nightly`.
"""

import json
import os
import socket
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from panolog.orchestrator.runs.folder import RunFolder
from panolog.orchestrator.runs.records import Outcome
from panolog.orchestrator.runs.state import ignore
from panolog.orchestrator.watch.follower.board import Board
from panolog.orchestrator.watch.follower.loggers import Logger
from panolog.orchestrator.watch.follower.sinks.interface import Facts, Point, Sink
from panolog.orchestrator.watch.follower.watcher import Watcher
from tests.deploy.files import ROOT
from tests.orchestrator.fakes import SetClock
from tests.orchestrator.watch.follower import histories
from tests.orchestrator.watch.follower.histories import Curves, expected
from tests.ray_head import BIN, read, wait_until

Make = Callable[[], Sink]


class Killed(BaseException):
    """The end of the follower in the middle of its work."""


class Memory(Sink):
    """A sink that keeps points as they come, and can be killed or fail within a piece."""

    def __init__(self) -> None:
        self.points: list[tuple[str, Point]] = []
        self.fails: dict[int, type[BaseException]] = {}  # by how many calls of `log` came before
        self.opened: list[str] = []
        self.finished: list[dict[str, float]] = []
        self.calls = 0

    def open(self, facts: Facts, known: str) -> str:
        self.opened.append(known)
        return "there"

    def present(self, task: str, after: int, until: int, names: Sequence[str]) -> set[tuple[str, int]]:
        return {
            (it.name, it.iteration)
            for of, it in self.points
            if of == task and it.name in names and after < it.iteration <= until
        }

    def log(self, task: str, points: Sequence[Point]) -> None:
        self.calls += 1
        fails = self.fails.pop(self.calls, None)
        kept = points[: len(points) // 2] if fails else points
        self.points += [(task, point) for point in kept]
        if fails:
            raise fails

    def finish(self, outcome: Outcome | None, metrics: Any, report: Path | None) -> None:
        self.finished.append(dict(metrics))

    @property
    def curves(self) -> Curves:
        found: Curves = {}
        for task, point in self.points:
            found.setdefault((task, point.name), []).append((point.iteration, point.value))
        return found


def follow(folder: RunFolder, make: Make, *, seconds: float = 1e6) -> Logger:
    """One follower that looks once, at the end of a driver. Args: seconds, on a clock that only it moves."""
    watcher, board = Watcher(folder, 1e9), Board(SetClock())
    watcher.look()
    board.publish(watcher.news(ended=True, left=True), seconds)
    logger = Logger("memory", make, board, folder.root, folder.root / "follower" / "sink.json")
    logger.run()
    return logger


def each_driver(root: Path, make: Make, again: Make | None = None) -> RunFolder:
    """A run of three drivers, each with its follower, which is replaced where it is killed."""
    for number in range(3):
        folder = histories.write(root, number, number + 1)
        folder.report.write_text("report")
        try:
            follow(folder, make)
        except Killed:
            follow(folder, again or make)
    return folder


def test_curves_of_a_run_that_is_killed_and_resumed_have_each_step_once(tmp_path: Path) -> None:
    sink = Memory()
    folder = each_driver(tmp_path / "run", lambda: sink)
    wanted = expected(folder)
    assert sink.curves == wanted
    assert {name for _, name in wanted} == {"rate", "loss", "psnr", "gaussians", "memory", "rate/means"}
    steps = [iteration for iteration, _ in sink.curves["coarse", "loss"]]
    assert steps == sorted(set(steps))
    assert steps[:6] == [5, 10, 15, 20, 25, 26]  # 30 to 45 of the first attempt came again
    assert not {30, 35, 40, 45} & set(steps)
    assert sink.finished == [{}, {}, {"psnr": 31.5}]
    assert sink.opened == ["", "there", "there"]


@pytest.mark.parametrize("call", [1, 2, 3, 4])
@pytest.mark.parametrize("error", [Killed, OSError])
def test_a_follower_killed_or_refused_within_a_piece_adds_the_rest(
    tmp_path: Path, call: int, error: type[BaseException]
) -> None:
    sink = Memory()
    sink.fails = {call: error}
    folder = each_driver(tmp_path / "run", lambda: sink)
    assert not sink.fails
    assert {key: sorted(curve) for key, curve in sink.curves.items()} == expected(folder)


def test_a_sink_that_never_answers_leaves_the_time_limit(tmp_path: Path) -> None:
    sink = Memory()
    sink.fails = dict.fromkeys(range(1, 10_000), OSError)
    folder = histories.write(tmp_path / "run")
    logger = follow(folder, lambda: sink, seconds=60.0)
    assert logger.problem == "not all was passed on: OSError"


def dying(kind: Any, left: Callable[[Any], object] = ignore) -> Any:
    """A kind of sink whose first one is killed in its third piece. Args: left, is called just before."""

    class Dies(kind):  # type: ignore[misc]
        died = False

        def log(self, task: str, points: Sequence[Point]) -> None:
            if Dies.died or task != "coarse" or points[0].iteration <= 20:
                super().log(task, points)
                return
            Dies.died = True
            super().log(task, points[: len(points) // 2])
            left(self)
            raise Killed

    return Dies


def of_32_bits(curves: Curves) -> Curves:
    return {key: [(step, float(np.float32(value))) for step, value in curve] for key, curve in curves.items()}


def test_tensorboard_reads_the_curves_of_the_database(tmp_path: Path) -> None:
    pytest.importorskip("tensorboard", reason="the package tensorboard is not installed")
    from tensorboard.backend.event_processing.event_multiplexer import EventMultiplexer  # noqa: PLC0415

    from panolog.orchestrator.watch.follower.sinks.tensorboard_sink import TensorBoardSink  # noqa: PLC0415

    board = tmp_path / "board"

    def left(sink: TensorBoardSink) -> None:
        sink.finish(None, {}, None)  # only so that no thread of a writer is left
        for file in board.rglob("events.*"):  # and a record was cut off
            with file.open("ab") as stream:
                stream.write(b"\x10\x00\x00")

    killed = dying(TensorBoardSink, left)
    folder = each_driver(tmp_path / "run", lambda: killed(board), lambda: TensorBoardSink(board))
    assert killed.died
    reader = EventMultiplexer(size_guidance={"scalars": 0}).AddRunsFromDirectory(str(board)).Reload()
    found: Curves = {}
    for run, tags in reader.Runs().items():
        for tag in tags["scalars"]:
            if not tag.startswith("final/"):
                found[run, tag] = [(it.step, it.value) for it in reader.Scalars(run, tag)]
    assert found == of_32_bits(expected(folder))
    assert [it.value for it in reader.Scalars(".", "final/psnr")] == [31.5]


def wandb_records(path: Path) -> Iterator[bytes]:
    """The records of a file of W&B: after 7 bytes the format of LevelDB's logs (its doc/log_format.md)."""
    data, at, whole = path.read_bytes(), 7, b""
    while at + 7 <= len(data):
        left = 32768 - at % 32768
        if left < 7:
            at += left
            continue
        size, kind = int.from_bytes(data[at + 4 : at + 6], "little"), data[at + 6]
        whole = (b"" if kind in (1, 2) else whole) + data[at + 7 : at + 7 + size]
        at += 7 + size
        if kind in (1, 4):
            yield whole


WANDB = """
import sys
from pathlib import Path
from panolog.orchestrator.watch.follower.sinks.wandb_sink import WandbSink
from tests.orchestrator.watch.follower.test_sinks import each_driver

root, kept = map(Path, sys.argv[1:])
each_driver(root, lambda: WandbSink("panolog", kept))
"""


@pytest.mark.nightly
@pytest.mark.system
def test_wandb_keeps_the_curves_of_the_database(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its client, which writes to the disk without a server, in a process that its service ends with."""
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))  # where the package keeps folders once imported
    module, reason = "wandb.proto.wandb_internal_pb2", "the package wandb is not installed: make nightly"
    messages = pytest.importorskip(module, reason=reason)
    folder, kept = RunFolder(tmp_path / "run"), tmp_path / "kept"
    environment = os.environ | {"WANDB_MODE": "offline"}
    subprocess.run([sys.executable, "-c", WANDB, folder.root, kept], check=True, cwd=ROOT, env=environment)
    found: Curves = {}
    for path in sorted(kept.glob("wandb/offline-run-*/*.wandb")):
        for data in wandb_records(path):
            record = messages.Record()
            record.ParseFromString(data)
            row = {"/".join(it.nested_key) or it.key: json.loads(it.value_json) for it in record.history.item}
            task = "coarse" if "coarse/iteration" in row else "block/000"
            step = row.pop(f"{task}/iteration", 0)
            for name, value in row.items():
                if name.startswith(task):
                    found.setdefault((task, name.removeprefix(f"{task}/")), []).append((step, value))
    assert found == expected(folder)


@pytest.fixture(scope="module")
def mlflow_server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """A server of MLflow on this machine, with its own store."""
    program = BIN / "mlflow"
    if not program.exists():
        pytest.skip("the package mlflow is not installed: make nightly")
    folder = tmp_path_factory.mktemp("mlflow")
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    store = ["--backend-store-uri", f"sqlite:///{folder}/store.db", "--artifacts-destination", str(folder)]
    command = [str(program), "server", "--host", "127.0.0.1", "--port", str(port), "--workers", "1", *store]
    with (folder / "log").open("wb") as log:
        # Its jobs, which nothing here uses, would leave a folder in shared memory.
        environment = os.environ | {"MLFLOW_SERVER_ENABLE_JOB_EXECUTION": "false"}
        server = subprocess.Popen(
            command, stdout=log, stderr=log, cwd=folder, env=environment, start_new_session=True
        )
    url = f"http://127.0.0.1:{port}"
    wait_until(lambda: read(f"{url}/health"), "the server of MLflow", 300)
    yield url
    os.killpg(server.pid, 15)
    server.wait(300)


@pytest.mark.nightly
@pytest.mark.system
def test_mlflow_has_the_curves_of_the_database(mlflow_server: str, tmp_path: Path) -> None:
    from mlflow.tracking import MlflowClient  # noqa: PLC0415

    from panolog.orchestrator.watch.follower.sinks.mlflow_sink import MlflowSink  # noqa: PLC0415

    killed = dying(MlflowSink)
    folder = each_driver(tmp_path / "run", lambda: killed(mlflow_server), lambda: MlflowSink(mlflow_server))
    assert killed.died
    client = MlflowClient(tracking_uri=mlflow_server)
    experiment = client.get_experiment_by_name("panolog")
    assert experiment is not None
    (run,) = client.search_runs([experiment.experiment_id])
    assert (run.info.run_name, run.info.status) == ("run", "FINISHED")
    assert run.data.params["width"] == "64"
    found: Curves = {}
    for key in run.data.metrics:
        if not key.startswith("final/"):
            task = "coarse" if key.startswith("coarse/") else "block/000"
            history = client.get_metric_history(run.info.run_id, key)
            found[task, key.removeprefix(f"{task}/")] = [(it.step, it.value) for it in history]
    assert {key: sorted(curve) for key, curve in found.items()} == expected(folder)
    assert [it.value for it in client.get_metric_history(run.info.run_id, "final/psnr")] == [31.5]
    assert [it.path for it in client.list_artifacts(run.info.run_id)] == ["report.html"]
