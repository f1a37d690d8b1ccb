"""Tasks on GPUs that Ray only counts: each has a process of its own, sees its GPU, and harms no other."""

import signal
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass

import psutil
import pytest
import ray

from panolog.orchestrator.cluster.connection import connect
from panolog.orchestrator.cluster.pool import RayPool
from panolog.orchestrator.resources.nodes import Placement
from panolog.orchestrator.resources.pool import Ended, Failed, Hello
from panolog.orchestrator.resources.usage import Usage
from panolog.orchestrator.run.records import Failure
from panolog.workers.events import Notice
from panolog.workers.tasks import TaskId
from tests.orchestrator.scripted import OnGpu
from tests.ray_head import wait_until

pytestmark = pytest.mark.system

CARDS = ("4", "6")  # of a machine that has more, of which this run may use two


@dataclass
class Attempt:
    """A task that has started."""

    task: TaskId
    pid: int
    card: str  # CUDA_VISIBLE_DEVICES


@pytest.fixture(scope="module")
def pool(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RayPool]:
    before = signal.getsignal(signal.SIGTERM)
    with pytest.MonkeyPatch.context() as patch:
        init = ray.init
        patch.setattr(ray, "init", lambda **options: init(**options | {"num_gpus": len(CARDS)}))
        patch.setenv("CUDA_VISIBLE_DEVICES", ",".join(CARDS))
        with connect(None, tmp_path_factory.mktemp("run")) as pool:
            yield pool
    signal.signal(signal.SIGTERM, before)


def message(pool: RayPool, task: TaskId) -> object:
    """The next message of one task, but for measurements of its machine."""
    found: list[object] = []

    def take() -> bool:
        if task in pool.ready(10) and not isinstance(said := pool.take(task), Usage):
            found.append(said)
        return bool(found)

    wait_until(take, f"a message of {task}")
    return found[0]


def start(pool: RayPool, gpus: float, *numbers: int, fails: str = "", uuid: str = "") -> list[Attempt]:
    """Starts blocks on so much of a GPU each, and waits until each has said where it is."""
    node = pool.nodes()[0].id
    tasks = [TaskId.block(number) for number in numbers]
    for task in tasks:
        pool.start(
            Placement(node, cpus=0.25, memory=2**30, gpus=gpus, uuid=uuid), OnGpu(task=task, fails=fails)
        )
    attempts = []
    for task in tasks:
        hello, notice = message(pool, task), message(pool, task)
        assert isinstance(hello, Hello)
        assert isinstance(notice, Notice)
        attempts.append(Attempt(task, hello.pid, notice.message))
    return attempts


def end(pool: RayPool, *attempts: Attempt) -> list[object]:
    """Requests tasks to stop; the last message of each."""
    for attempt in attempts:
        pool.stop(attempt.task)
    last: list[object] = []
    for attempt in attempts:
        said = message(pool, attempt.task)
        while not isinstance(said, Ended | Failed):
            said = message(pool, attempt.task)
        last.append(said)
    return last


def works(pool: RayPool, attempt: Attempt) -> bool:
    """Whether it sends more than what it had sent before."""
    later = [message(pool, attempt.task) for _ in range(20)]
    return all(said == Notice(attempt.task, "works") for said in later) and psutil.pid_exists(attempt.pid)


def test_each_has_a_card_and_a_process_of_its_own(pool: RayPool) -> None:
    pids = set()
    for round_ in range(2):
        attempts = start(pool, 1.0, 2 * round_, 2 * round_ + 1)
        assert sorted(attempt.card for attempt in attempts) == list(CARDS)
        pids |= {attempt.pid for attempt in attempts}
        assert end(pool, *attempts) == [Ended()] * len(attempts)
    assert len(pids) == 4


def test_tasks_that_share_a_card_see_the_same_one(pool: RayPool) -> None:
    attempts = start(pool, 0.5, 0, 1, 2, 3)
    assert Counter(attempt.card for attempt in attempts) == dict.fromkeys(CARDS, 2)
    assert len({attempt.pid for attempt in attempts}) == 4
    assert end(pool, *attempts) == [Ended()] * len(attempts)


def test_where_cards_are_unequal_the_one_that_was_chosen_is_seen(pool: RayPool) -> None:
    attempts = start(pool, 1.0, 0, uuid="GPU-bb22")
    assert attempts[0].card == "GPU-bb22"
    assert end(pool, *attempts) == [Ended()] * len(attempts)


@pytest.mark.parametrize(
    ("how", "kind", "reason"),
    [
        (
            "illegal access",
            Failure.ERROR,
            "AcceleratorError: CUDA error: an illegal memory access was encount",
        ),
        ("crash", Failure.LOST, "the worker process died: killed or crashed"),
    ],
)
def test_one_that_has_broken_its_context_harms_no_other(
    pool: RayPool, how: str, kind: Failure, reason: str
) -> None:
    """The other card, and half of its own, are in use; its next attempt gets another process."""
    others = start(pool, 1.0, 1) + start(pool, 0.5, 2)
    (broken,) = start(pool, 0.5, 0, fails=how)
    assert broken.card == others[1].card != others[0].card
    (failed,) = end(pool, broken)
    assert isinstance(failed, Failed)
    assert failed.kind == kind
    assert failed.reason.startswith(reason)
    (again,) = start(pool, 0.5, 0)
    assert again.card == broken.card
    assert again.pid != broken.pid
    assert all(works(pool, attempt) for attempt in [again, *others])
    wait_until(lambda: not psutil.pid_exists(broken.pid), "the end of its process")
    assert end(pool, again, *others) == [Ended()] * 3
