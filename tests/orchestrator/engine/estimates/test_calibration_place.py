"""Where a job is calibrated."""

from collections.abc import Mapping
from pathlib import Path

import pytest

from panolog.orchestrator.engine.estimates import calibration
from panolog.orchestrator.engine.estimates.calibration import await_machine, calibrate
from panolog.orchestrator.engine.scheduling.leaving import LeaveNotice
from panolog.orchestrator.engine.scheduling.scaling import Group, Growth
from panolog.orchestrator.runs.config import RunConfig
from panolog.orchestrator.runs.machines.nodes import Node
from panolog.orchestrator.runs.records import Leaving
from panolog.scene.errors import ClusterError
from tests.orchestrator.calibrated import says
from tests.orchestrator.fakes import FakePool
from tests.workers.small import WIDTH, small_scene

NODES = [Node(name, name, 2, 2**40) for name in ("a", "b")]


@pytest.mark.parametrize(("leaving", "where"), [([], "a"), (["a"], "b"), (["a", "b"], "a")])
def test_a_node_that_leaves_is_not_calibrated_on_if_another_stays(
    leaving: list[str], where: str, tmp_path: Path
) -> None:
    pool = FakePool(says, NODES)
    pool.leaving = {name: LeaveNotice(Leaving.PREEMPTION, 60) for name in leaving}
    calibrate(pool, small_scene(tmp_path), RunConfig(width=WIDTH, device="cpu"))
    assert [placement.node for placement, _ in pool.started] == [where]


class ComingPool(FakePool):
    """A machine joins when the driver has waited twice."""

    def __init__(self, groups: tuple[Group, ...]) -> None:
        super().__init__(says, [])
        self.groups, self.left = groups, 2
        self.requests: list[dict[str, int]] = []
        self.when_waiting(self._wait)

    def _wait(self) -> None:
        self.left -= 1
        if not self.left:
            self.join(NODES[0])

    def growth(self) -> Growth:
        return Growth(self.groups, trouble="no spot machines" if self.left == 1 else "")

    def request(self, wanted: Mapping[str, int]) -> None:
        self.requests.append(dict(wanted))


def test_without_a_machine_one_is_requested_and_waited_for() -> None:
    small, large = Group("small", 4, 2, memory=2**33), Group("large", 4, 8, memory=2**36)
    pool, said = ComingPool((large, small)), list[str]()
    assert await_machine(pool, lambda: 2**30, said.append, cuda=False) is not None
    assert pool.requests == [{"small": 1}, {"small": 1}, {}]
    requested = "waiting for a machine: small (2 cores, 8.0 GiB) is requested from Ray's autoscaler"
    assert said == [requested, f"{requested}; it reports: no spot machines", ""]
    pool = ComingPool((large, small))
    await_machine(pool, lambda: 2**34, said.append, cuda=False)
    assert pool.requests[0] == {"large": 1}


def test_where_none_can_be_started_one_may_join() -> None:
    pool, said = ComingPool(()), list[str]()
    assert await_machine(pool, lambda: 0, said.append, cuda=False) is None
    assert said == ["waiting for a machine with a core: the cluster has none", ""]


def test_a_cluster_that_stays_empty_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(calibration, "_JOIN_S", 0.0)
    with pytest.raises(ClusterError, match="no node of the cluster has a core for tasks"):
        await_machine(FakePool(says, []), lambda: 0, lambda _: None, cuda=False)


def test_where_there_is_a_machine_nothing_is_requested() -> None:
    pool = ComingPool((Group("small", 4, 2),))
    pool.join(NODES[1])
    assert await_machine(pool, lambda: 0, lambda _: None, cuda=False) is None
    assert pool.requests in ([], [{}])
