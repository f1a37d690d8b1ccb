"""A run on three hosts that share nothing, whose scene is in an object store that all of them reach."""

import re
import sys
from pathlib import Path

import pytest

from panolog.orchestrator.run.folder import RunFolder
from panolog.orchestrator.run.records import Outcome, RunEnded, Transferred
from panolog.orchestrator.run.store import read_records
from panolog.synthetic.make import make_town
from panolog.workers.tasks import COARSE
from tests.orchestrator.cluster.test_machines import HEAD, WORKERS, Cluster, three_hosts
from tests.ray_head import BIN

# The cache and the reading of scenes through it have tests of their own: this is both on hosts.
pytestmark = [pytest.mark.system, pytest.mark.nightly]

PORT, URL = 5000, "s3://places/town"
PROVIDER = {
    "AWS_ENDPOINT_URL": f"http://{HEAD}:{PORT}",
    "AWS_ACCESS_KEY_ID": "key",
    "AWS_SECRET_ACCESS_KEY": "secret",
    "AWS_DEFAULT_REGION": "us-east-1",
    "AWS_EC2_METADATA_DISABLED": "true",
}
SETTINGS: tuple[str, ...] = ("--iterations", "20", "--width", "64", "--device", "cpu", "--blocks", "2x1x1")
SETTINGS += ("--set", "sky.count=100", "--set", "deliver=false")
# Waits for the server, makes the bucket and stores a folder.
STORE = """
import socket, sys, time
from pathlib import Path
from s3fs import S3FileSystem

host, port, folder, url = sys.argv[1:]
for _ in range(600):
    try:
        socket.create_connection((host, int(port)), 1).close()
        break
    except OSError:
        time.sleep(0.1)
files = S3FileSystem()
files.mkdir("places")
files.put(folder, url, recursive=True)
"""
# What moto's server says of each request: who, which method, which path, with which status.
REQUEST = re.compile(r'^(\S+) - - \[[^]]*\] "(\w+) /places/town/(\S*) HTTP/1\.\d" (\d+)', re.MULTILINE)


def store(cluster: Cluster, scene: Path, log: Path) -> None:
    """Starts a server on the head, and stores a scene there."""
    server = (sys.executable, "-m", "moto.server", "-H", "0.0.0.0", "-p", PORT)
    with log.open("w") as output:
        cluster.hosts.launch("head", *server, env=cluster.environment, stdout=output, stderr=output)
    command = (sys.executable, "-c", STORE, HEAD, PORT, f"{scene}/", URL)
    assert cluster.hosts.launch("head", *command, env=cluster.environment).wait() == 0


def test_workers_read_a_scene_from_its_store_each_through_its_own_cache(tmp_path: Path) -> None:
    scene = make_town(tmp_path / "town", panoramas=9, width=512, points=300)
    smallest = min(path.stat().st_size for path in (scene / "images").iterdir())
    run, log = tmp_path / "run", tmp_path / "log"
    with three_hosts(tmp_path) as cluster:
        cluster.environment |= PROVIDER | {"PANOLOG_STORE_CACHE": str(tmp_path / "cache")}
        store(cluster, scene, log)
        before = log.stat().st_size
        cluster.start()
        command = (BIN / "panolog", "run", URL, "-o", run, *SETTINGS, "--address", f"{HEAD}:6379")
        with (tmp_path / "run.log").open("w") as errors:
            process = cluster.hosts.launch("head", *command, env=cluster.environment, stderr=errors)
            assert process.wait() == 0, (tmp_path / "run.log").read_text()
        kept = {address: copies(cluster, host, tmp_path) for host, address in WORKERS.items()}
    reads: dict[str, list[str]] = {address: [] for address in (HEAD, *WORKERS.values())}
    for host, method, name, status in REQUEST.findall(log.read_text()[before:]):
        if method == "GET" and status == "200" and name.startswith("images/"):  # 206: a range
            reads[host].append(name)
    for address in WORKERS.values():
        assert reads[address]
        assert len(reads[address]) == len(set(reads[address]))  # once for all its tasks
        assert kept[address] >= len(reads[address])
    history = [item.record for item in read_records(RunFolder(run).database)]
    assert history[-1] == RunEnded(Outcome.DONE)
    moved = [it.received for it in history if isinstance(it, Transferred) and it.task == COARSE]
    assert sum(moved) < smallest  # the initial Gaussians, and no panorama


def copies(cluster: Cluster, host: str, folder: Path) -> int:
    """How many objects a host has in its cache, which lies in a folder that no other host sees."""
    output = folder / f"{host}.copies"
    with output.open("w") as file:
        find = ("find", folder / "cache" / "objects", "-type", "f")
        assert cluster.hosts.launch(host, *find, stdout=file).wait() == 0
    return len(output.read_text().splitlines())
