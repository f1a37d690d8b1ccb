"""Nodes of a real Ray cluster that announce that they leave: by their provider, and by draining."""

import shutil
import tempfile
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import psutil
import pytest
import ray
from ray.cluster_utils import Cluster

from panolog.orchestrator.engine.cluster import agents
from panolog.orchestrator.engine.cluster.leave import leave, raylets
from panolog.orchestrator.engine.cluster.pool import RayPool
from panolog.orchestrator.engine.scheduling.metadata import VARIABLE
from panolog.orchestrator.engine.scheduling.pool import Ended, Hello, Message
from panolog.orchestrator.runs.machines.nodes import Placement
from panolog.orchestrator.runs.records import Leaving
from panolog.scene.errors import ClusterError
from panolog.workers.events import Checkpoint
from tests.metadata_service import Metadata, metadata
from tests.orchestrator.scripted import TASK, Works
from tests.ray_head import wait_until

pytestmark = pytest.mark.system


@dataclass
class Spot:
    """A pool whose only node with cores is a spot machine."""

    pool: RayPool
    node: str  # Node.id
    service: Metadata

    def begin(self) -> None:
        self.pool.start(Placement(self.node, 1.0, 2**30), Works())
        assert isinstance(self.message(), Hello)

    def message(self) -> Message:
        assert self.pool.ready(300) == [TASK]
        return self.pool.take(TASK)

    def end(self) -> None:
        self.pool.stop(TASK)
        self.wait_for_the_end()

    def wait_for_the_end(self) -> None:
        messages = [self.message()]
        while not isinstance(messages[-1], Ended):
            messages.append(self.message())
        assert any(isinstance(message, Checkpoint) for message in messages)

    def kind(self) -> Leaving | None:
        self.pool.nodes()
        notice = self.pool.notices().get(self.node)
        return notice.kind if notice else None


@pytest.fixture(scope="module")
def cluster() -> Iterator[Cluster]:
    nice = {"worker_niceness": 0}  # by Ray's default of 15, workers starve under load
    head = {"num_cpus": 0, "include_dashboard": False, "_system_config": nice}
    found = Cluster(initialize_head=True, head_node_args=head)
    try:
        ray.init(address=found.address, log_to_driver=False)
        yield found
    finally:
        ray.shutdown()
        found.shutdown()  # type: ignore[no-untyped-call]
    shutil.rmtree(Path(tempfile.gettempdir(), "ray"), ignore_errors=True)


@pytest.fixture
def spot(cluster: Cluster, monkeypatch: pytest.MonkeyPatch) -> Iterator[Spot]:
    with metadata("amazon") as service:
        monkeypatch.setenv(VARIABLE, service.url)
        node = cluster.add_node(num_cpus=1)
        monkeypatch.delenv(VARIABLE)
        cluster.wait_for_nodes(timeout=120)
        pool = RayPool(None, "test")
        try:
            yield Spot(pool, node.node_id, service)
        finally:
            pool.close()
            cluster.remove_node(node)


def agent_of_the_node() -> psutil.Process:
    def found() -> list[psutil.Process]:
        return [it for it in psutil.Process().children(recursive=True) if it.name() == "ray::Agent"]

    wait_until(lambda: len(found()) == 1, "the agent")
    return found()[0]


def test_a_provider_takes_a_node_away(spot: Spot) -> None:
    spot.begin()
    assert spot.kind() is None
    agent_of_the_node().kill()  # it comes back
    spot.service.spot(7200)
    wait_until(lambda: spot.kind() == Leaving.PREEMPTION, "the notice")
    notice = spot.pool.notices()[spot.node]
    assert notice.seconds == pytest.approx(7200, abs=1200)
    agent = agent_of_the_node()
    agent.suspend()
    spot.pool.stop(TASK)  # is lost with the agent, and requested again of the one that comes back
    agent.kill()
    spot.wait_for_the_end()
    assert spot.kind() == Leaving.PREEMPTION  # known as long as the node is there


def test_an_agent_ends_where_nothing_runs_and_a_node_drains_while_its_task_saves_and_then_ends(
    spot: Spot, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(ClusterError, match=r"nodes of Ray: .*choose one with --node"):
        leave(1)
    spot.begin()
    spot.end()
    with monkeypatch.context() as patch:
        patch.setattr(agents, "_UNUSED_S", 0.0)
        agent = agent_of_the_node()
        spot.kind()
        assert psutil.wait_procs([agent], timeout=300)[0]  # Ray does not start it again
        assert spot.kind() is None
    spot.begin()
    with ThreadPoolExecutor(1) as threads:
        left = threads.submit(leave, 600, spot.node[:12])
        wait_until(lambda: spot.kind() == Leaving.DRAIN, "the drain")
        assert not left.done()
        spot.end()  # Ray starts no task there any more: the agent stops this one
        wait_until(lambda: spot.kind() is None, "its end")  # its agent has ended too, so the node has
        assert left.result(300)
    assert spot.node not in {raylet.node for raylet in raylets()}


def test_where_ray_does_not_run_there_is_no_node(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("panolog.orchestrator.engine.cluster.leave.raylets", list)
    with pytest.raises(ClusterError, match="no node of Ray"):
        leave(1)
