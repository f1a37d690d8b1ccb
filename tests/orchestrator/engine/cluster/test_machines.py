"""A run on three hosts that share nothing, and one of them loses its network in the middle of a block."""

import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest

from panolog.orchestrator.cli.session import session
from panolog.orchestrator.engine.driver.local_pool import local_pool
from panolog.orchestrator.runs.config import load_config
from panolog.orchestrator.runs.database import read_records
from panolog.orchestrator.runs.folder import RunFolder
from panolog.orchestrator.runs.records import (
    CheckpointSaved,
    Failure,
    Stored,
    TaskFailed,
    TaskStarted,
    Transferred,
)
from panolog.orchestrator.runs.state import ignore
from panolog.synthetic.make import make_town
from panolog.workers.tasks import COARSE, Stage, TaskId
from tests.orchestrator.cli.program import shown
from tests.orchestrator.engine.cluster.hosts import Hosts, NoHostsError
from tests.ray_head import BIN, cluster_environment, wait_until

pytestmark = [pytest.mark.system, pytest.mark.nightly]  # Ray gives a lost machine a minute

HEAD, ADDRESS = "10.77.0.1", "10.77.0.1:6379"
WORKERS = {"one": "10.77.0.2", "two": "10.77.0.3"}
SETS: tuple[str, ...] = ("iterations=20", "sky.count=100", "checkpoint.every=5", "checkpoint.share=1")
SETS += ("device=cpu", "densify.start=10", "densify.every_floor=5")
SETTINGS = tuple(word for setting in SETS for word in ("--set", setting))

# The driver waits for the test to cut a cable after the first checkpoint of a block on the host "two", before
# it reads on, so the worker cannot come to its end; and to connect it again after the failure.
SCRIPT = """
import sys
from panolog.orchestrator.cli import app
from panolog.orchestrator.cli.session import driving
from panolog.orchestrator.engine.driver.driver import Driver

blocks, cut = set(), []

def request(state):
    print(state, file=sys.__stdout__, flush=True)
    sys.stdin.readline()

def driver(job, journal, pool, hooks, stop):
    show = journal.on_change

    def on_change(state, stored):
        show(state, stored)
        for record in (item.record for item in stored):
            kind = type(record).__name__
            if kind == "TaskStarted" and record.node == "two" and record.task.stage == "block":
                blocks.add(record.task)
            if kind == "CheckpointSaved" and record.task in blocks and not cut:
                cut.append(record.task)
                request("down")
            if kind == "TaskFailed" and record.task in cut:
                request("up")

    journal.on_change = on_change
    return Driver(job, journal, pool, hooks, stop)

driving.Driver = driver
app.main()
"""
# What a service manager does: a worker that ends because it was given up is started again.
TWICE = ("sh", "-c", '"$@"; exec "$@"', "sh")


class Cluster:
    """A Ray head and two workers, on which the folder `hidden` does not exist."""

    def __init__(self, hosts: Hosts, folder: Path) -> None:
        self.hosts = hosts
        self.folder = folder
        self.environment = cluster_environment()

    def start(self) -> None:
        self._ray("head", HEAD, "--head", "--port=6379", "--num-cpus=0", "--include-dashboard=false")
        for host, address in WORKERS.items():
            self._ray(host, address, f"--address={ADDRESS}", "--num-cpus=1")
        wait_until(lambda: all(self.starts(host) for host in ("head", *WORKERS)), "three hosts with Ray", 240)

    def starts(self, host: str) -> int:
        return self.log(host).read_text().count("Ray runtime started")

    def log(self, host: str) -> Path:
        return self.folder / f"{host}.log"

    def drive(self, *arguments: object, errors: Path) -> int:
        """Runs PanoLOG on the head; plugs the cable of "two" as it requests. Returns its exit code."""
        with errors.open("w") as stderr:
            process = self.hosts.launch(
                "head",
                *(sys.executable, "-c", SCRIPT, *arguments, "--address", ADDRESS),
                env=self.environment,
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=stderr,
            )
        assert process.stdin is not None
        assert process.stdout is not None
        for line in process.stdout:
            subprocess.run(self.hosts.cable("two", line.strip()), check=True)
            process.stdin.write("\n")
            process.stdin.flush()
        return process.wait()

    def _ray(self, host: str, address: str, *options: str) -> None:
        (self.folder / host).mkdir()
        command = [*TWICE, BIN / "ray", "start", "--block", f"--node-ip-address={address}", *options]
        command += ["--object-store-memory=100000000", f"--temp-dir={self.folder / host}"]
        with self.log(host).open("w") as output:
            self.hosts.launch(host, *command, env=self.environment, stdout=output, stderr=output)


@pytest.fixture
def cluster(tmp_path: Path) -> Iterator[Cluster]:
    """A cluster that is not started yet; its workers lack the test's folder."""
    try:
        hosts = Hosts({"head": None, "one": tmp_path, "two": tmp_path})
    except NoHostsError as error:
        pytest.skip(f"hosts of their own cannot be made here: {error}")
    with TemporaryDirectory(prefix="panolog-", dir="/tmp") as folder:  # short: Ray has its sockets there
        try:
            yield Cluster(hosts, Path(folder))
        finally:
            hosts.close()


def test_a_host_loses_its_network_and_gets_it_back(cluster: Cluster, tmp_path: Path) -> None:
    scene = make_town(tmp_path / "town", panoramas=9, width=64, points=300)
    calm, run = tmp_path / "calm", tmp_path / "run"
    with local_pool() as pool:
        session.start(scene, calm, load_config(sets=SETS), None, ignore, pool)
    cluster.start()
    for host in WORKERS:
        assert cluster.hosts.launch(host, "test", "-e", scene).wait() == 1
    errors = tmp_path / "run.log"
    assert cluster.drive("run", scene, "-o", run, *SETTINGS, errors=errors) == 0, errors.read_text()

    for name in ("coarse/model.ply", "partition/plan.json", "point_cloud.ply"):
        assert (run / name).read_bytes() == (calm / name).read_bytes(), name
    history = read_records(RunFolder(run).database)
    check_the_cut(history)
    check_what_moved(history, run)
    assert not [it for it in (cluster.folder / "one").glob("panolog/*/*/*") if it.name != "lock"]  # copies
    wait_until(lambda: cluster.starts("two") == 2, "the return of the lost host")


def check_the_cut(history: list[Stored]) -> None:
    """One block was lost with its host and continued from its checkpoint; the workers did all work."""
    (failed,) = [stored.record for stored in history if isinstance(stored.record, TaskFailed)]
    assert failed.kind == Failure.LOST
    starts = [stored.record for stored in history if isinstance(stored.record, TaskStarted)]
    assert {start.node for start in starts} == set(WORKERS)
    first, second = (start for start in starts if start.task == failed.task)
    assert (first.node, first.iteration) == ("two", 0)
    saved = [
        stored.record.iteration
        for stored in history
        if isinstance(stored.record, CheckpointSaved) and stored.record.task == failed.task
    ]
    assert second.iteration in saved


def check_what_moved(history: list[Stored], run: Path) -> None:
    """Every byte is counted and shown."""
    received: dict[TaskId, int] = {}
    for stored in history:
        if isinstance(stored.record, Transferred):
            task = stored.record.task
            received[task] = received.get(task, 0) + stored.record.received
    # How many panoramas the calibration has fetched before is a matter of time; a model is fetched anew.
    assert received[COARSE] > 0
    model = (run / "coarse" / "model.ply").stat().st_size
    assert sum(count for task, count in received.items() if task.stage is Stage.SCORE) > model
    moved = shown("status", run)["moved"]
    assert moved["received"] == sum(received.values())
    assert moved["sent"] > (run / "point_cloud.ply").stat().st_size
