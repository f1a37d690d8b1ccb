"""A driver whose machines come when it requests them."""

from collections.abc import Iterator, Mapping

from panolog.orchestrator.engine.driver.driver import Hooks
from panolog.orchestrator.engine.scheduling.scaling import Group, Growth
from panolog.orchestrator.runs.machines.nodes import Node
from panolog.orchestrator.runs.records import Noticed, RunContinued, RunWaiting
from panolog.workers.events import Event
from panolog.workers.specs import TaskSpec
from panolog.workers.tasks import COARSE
from tests.orchestrator.fakes import FakePool, Harness, SetClock, well

GROUP = Group("small", most=3, cpus=1, memory=2**40)


class GrowingPool(FakePool):
    """One machine joins each time that the driver waits, if it has requested some."""

    def __init__(self, clock: SetClock, startup: float) -> None:
        super().__init__(self._work, [])
        self._clock, self._startup = clock, startup
        self.wanted: dict[str, int] = {}
        self.requests: list[dict[str, int]] = []
        self.trouble = ""
        self.when_waiting(self._join)

    def _work(self, spec: TaskSpec) -> Iterator[Event]:
        self._clock.now += 600
        yield from well(spec)

    def _join(self) -> None:
        self._clock.now += self._startup
        if self.wanted.get("small") and len(self.nodes()) < GROUP.most:
            self.join(GROUP.node(len(self.nodes())))

    def growth(self) -> Growth:
        members = {node.id: "small" for node in self.nodes()}
        return Growth((GROUP,), members, trouble=self.trouble)

    def request(self, wanted: Mapping[str, int]) -> None:
        if wanted != self.wanted:
            self.wanted = dict(wanted)
            self.requests.append(self.wanted)


def test_a_run_without_a_machine_requests_some_while_it_needs_them_and_says_what_it_waits_for(
    harness: Harness,
) -> None:
    harness.clock = clock = SetClock()
    pool, planning = GrowingPool(clock, startup=120), list[dict[str, int]]()
    harness.drive(pool=pool, hooks=Hooks(lambda *_: planning.append(dict(pool.wanted))))
    waits = [record.reason for record in harness.records(RunWaiting)]
    assert waits[0].startswith("waiting for machines: 1 of small (1 core, 1024.0 GiB), requested from Ray's")
    assert [record.seconds for record in harness.records(RunContinued)] == [120]
    messages = [record.message for record in harness.records(Noticed)]
    assert "requested from Ray's autoscaler for coarse: 1 more of small (1 core, 1024.0 GiB)" in messages
    assert planning == [{}]  # the driver works itself
    assert pool.requests == [{"small": 1}, {}]
    assert harness.state.waiting == ""


def test_why_no_machine_comes_is_said_again_when_it_changes(harness: Harness) -> None:
    harness.clock = clock = SetClock()
    pool = GrowingPool(clock, startup=20)
    left = ["no spot machines left", "quota exceeded"]

    def join() -> None:
        clock.now += 20
        pool.trouble = left.pop(0) if left else ""
        if not pool.trouble:
            pool.join(GROUP.node(0))

    pool.when_waiting(join)
    harness.drive(pool=pool)
    waits = [record.reason.rpartition("; ")[2] for record in harness.records(RunWaiting)]
    assert waits[1:3] == ["it reports: no spot machines left", "it reports: quota exceeded"]


def test_a_cluster_without_an_autoscaler_says_that_it_has_no_machine(harness: Harness) -> None:
    harness.clock = SetClock()
    pool = FakePool(well, [])
    pool.when_waiting(lambda: pool.join(Node("a", "host", 1, 2**40)) if not pool.nodes() else None)
    harness.drive(pool=pool)
    (waiting,) = harness.records(RunWaiting)
    assert waiting.reason == "waiting for a machine with a core: the cluster has none now"
    assert harness.state.task(COARSE).attempts == 1
