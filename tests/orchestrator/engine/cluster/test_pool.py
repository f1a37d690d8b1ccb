"""What the pool says of workers that end badly, how it stops them, and which GPU each has: with a real Ray.

Ray only counts the GPUs.
"""

import os
import signal
import sys
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import islice
from subprocess import PIPE, Popen

import psutil
import pytest
import ray
from ray.exceptions import GetTimeoutError

from panolog.orchestrator.engine.cluster.connection import connect
from panolog.orchestrator.engine.cluster.nodes import describe
from panolog.orchestrator.engine.cluster.places import Places
from panolog.orchestrator.engine.cluster.pool import RayPool
from panolog.orchestrator.engine.scheduling.pool import Ended, Failed, Hello, Message
from panolog.orchestrator.runs.machines.machine import oom_kills
from panolog.orchestrator.runs.machines.nodes import Placement
from panolog.orchestrator.runs.machines.usage import Usage
from panolog.orchestrator.runs.records import Failure
from panolog.workers.events import Notice
from panolog.workers.specs import TaskSpec
from panolog.workers.tasks import TaskId
from tests.nvidia_smi import print_gpus
from tests.orchestrator import scripted
from tests.orchestrator.scripted import TASK, Fails, Holds, OnGpu, Short, Works
from tests.ray_head import wait_until

pytestmark = pytest.mark.system

CARDS = ("4", "6")  # of a machine that has more, of which this run may use two


@pytest.fixture(scope="module")
def pool(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RayPool]:
    before = signal.getsignal(signal.SIGTERM)
    with pytest.MonkeyPatch.context() as patch:
        init, more = ray.init, {"num_gpus": len(CARDS), "include_dashboard": True}
        patch.setattr(ray, "init", lambda **options: init(**options | more))
        path, folder = os.environ["PATH"], tmp_path_factory.mktemp("bin")
        print_gpus(folder, patch, "".join(f"{i}, GPU-{i}, NVIDIA L4, 22900, 23034\n" for i in range(8)))
        patch.setenv("PATH", f"{folder}:{path}")
        patch.setenv("CUDA_VISIBLE_DEVICES", ",".join(CARDS))
        with connect(None, tmp_path_factory.mktemp("run")) as pool:
            yield pool
    signal.signal(signal.SIGTERM, before)


def here_on(pool: RayPool) -> Placement:
    return Placement(pool.nodes()[0].id, cpus=1.0, memory=2**30)


def messages(pool: RayPool, spec: TaskSpec) -> Iterator[Message]:
    return scripted.messages(pool, spec, here_on(pool))


def test_a_failure_says_of_which_kind_it_is_and_is_not_cancelled(
    pool: RayPool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The kinds are those of scheduling/test_pool.py."""
    monkeypatch.setattr(ray, "cancel", lambda *_, **__: pytest.fail("kills what its worker runs next"))
    hello, *sent = messages(pool, Fails(how="wrong"))
    assert isinstance(hello, Hello)
    assert sent == [Notice(TASK, "wrong"), Failed("a.jpg is truncated", Failure.INPUT)]


def test_a_machine_with_another_version_does_not_train(
    pool: RayPool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Nor one whose version was replaced during the run."""
    monkeypatch.setattr("panolog.orchestrator.engine.cluster.pool.own_code", lambda: "0123456789ab")
    hello, failed = messages(pool, Works())
    assert isinstance(hello, Hello)
    assert isinstance(failed, Failed)
    assert "has another PanoLOG than the driver (sources " in failed.reason
    assert failed.reason.endswith("not 0123456789ab): install the same version on all machines")


def test_a_kill_for_want_of_memory_is_known_among_others(
    pool: RayPool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What others are is shown by a task that crashes on its GPU."""
    monkeypatch.setattr("panolog.orchestrator.engine.cluster.nodes.oom_kills", lambda: oom_kills() + 1)
    said = messages(pool, Works())
    hello = next(said)
    assert isinstance(hello, Hello)
    os.kill(hello.pid, signal.SIGKILL)
    *_, failed = said
    assert isinstance(failed, Failed)
    assert (failed.kind, failed.reason) == (
        Failure.MEMORY,
        "out of memory: the system killed the worker",
    )


def test_the_place_of_a_worker_that_hangs_is_given_to_the_next(pool: RayPool) -> None:
    """Both tasks need all of its cores."""
    whole = replace(here_on(pool), cpus=float(pool.nodes()[0].cpus))
    hello = next(scripted.messages(pool, Works(), whole))
    assert isinstance(hello, Hello)
    os.kill(hello.pid, signal.SIGSTOP)
    pool.cancel(TASK)
    assert pool.ready(0.1) == []
    again = scripted.messages(pool, Works(), whole)
    other = next(again)
    assert isinstance(other, Hello)
    assert other.pid != hello.pid
    assert not psutil.pid_exists(hello.pid)
    pool.stop(TASK)
    assert isinstance(list(again)[-1], Ended)


def test_tasks_on_the_cpu_share_a_process_which_has_imported_everything(pool: RayPool) -> None:
    pids = set()
    for _ in range(2):
        hello, *_, ended = messages(pool, Short())
        assert isinstance(hello, Hello)
        assert isinstance(ended, Ended)
        pids.add(hello.pid)
    assert len(pids) == 1


def test_a_worker_whose_message_is_lost_is_ended(pool: RayPool, monkeypatch: pytest.MonkeyPatch) -> None:
    def get(*_: object, **__: object) -> None:
        raise GetTimeoutError("too late")

    running = messages(pool, Works())
    hello = next(running)
    assert isinstance(hello, Hello)
    process = psutil.Process(hello.pid)
    with monkeypatch.context() as patch:
        patch.setattr(ray, "get", get)
        failed = next(running)
    assert failed == Failed("a message of the worker did not arrive", Failure.LOST, "too late")
    assert psutil.wait_procs([process], timeout=60)[0]


def test_what_workers_of_the_run_hold_counts_as_free(pool: RayPool, monkeypatch: pytest.MonkeyPatch) -> None:
    """A driver that comes after a kill finds workers of the last one, which end."""
    monkeypatch.setattr("panolog.orchestrator.engine.cluster.nodes.memory", lambda: 0)  # of others
    running = messages(pool, Holds(size=2**29))
    hello, _ = next(running), next(running)
    assert isinstance(hello, Hello)
    name = psutil.Process(hello.pid).cmdline()[0].removeprefix("ray::")
    usable, *_ = describe(0, name)
    assert usable >= 2**29
    pool.cancel(TASK)


OTHER = """
import sys
import ray

@ray.remote
class Other:
    def holds(self):
        return "holds"

ray.init(address=sys.argv[1], log_to_driver=False)
actor = Other.options(num_cpus=float(sys.argv[2])).remote()
print(ray.get(actor.holds.remote()), flush=True)
sys.stdin.read()
"""


def test_a_task_that_waits_for_another_program_differs_from_one_that_hangs(pool: RayPool) -> None:
    node, whole = pool.nodes()[0].id, replace(here_on(pool), cpus=float(pool.nodes()[0].cpus))
    places, address = Places(), ray.get_runtime_context().gcs_address
    command = [sys.executable, "-c", OTHER, address, str(whole.cpus)]
    with Popen(command, stdin=PIPE, stdout=PIPE, text=True) as other:
        assert other.stdout is not None
        assert other.stdout.readline() == "holds\n"
        pool.start(whole, Works())
        waits = pool._running[TASK].messages.completed().task_id().hex()
        wait_until(lambda: places.waits(waits, node), "the task waits for the other program")
        other.kill()
    assert pool.ready(60) == [TASK]
    assert not places.waits(waits, node)  # it has its worker
    pool.cancel(TASK)


@dataclass
class Attempt:
    task: TaskId
    pid: int
    card: str  # CUDA_VISIBLE_DEVICES


def message(pool: RayPool, task: TaskId) -> object:
    """The next message of one task, but for measurements of its machine."""
    found: list[object] = []

    def take() -> bool:
        if task in pool.ready(10) and not isinstance(said := pool.take(task), Usage):
            found.append(said)
        return bool(found)

    wait_until(take, f"a message of {task}")
    return found[0]


def test_a_worker_reports_its_gpu(pool: RayPool) -> None:
    """Where Ray may be others' too, it chooses."""
    (node,) = pool.nodes()
    assert [gpu.uuid for gpu in node.gpus] == ["GPU-4", "GPU-6"]
    where = Placement(node.id, 0.25, memory=0, gpus=1.0, gpu=0)  # no card by its UUID
    hello, notice = islice(scripted.messages(pool, OnGpu(device="cuda"), where), 2)
    assert isinstance(hello, Hello)
    assert isinstance(notice, Notice)
    assert hello.card == "GPU-" + notice.message.removeprefix("GPU-")
    pool.cancel(TASK)


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
    later = [message(pool, attempt.task) for _ in range(20)]
    return all(said == Notice(attempt.task, "works") for said in later) and psutil.pid_exists(attempt.pid)


def test_each_has_a_card_and_a_process_and_one_that_has_broken_its_context_harms_no_other(
    pool: RayPool,
) -> None:
    """Two tasks share each card; the next attempt gets another process."""
    others = start(pool, 0.5, 0) + start(pool, 0.6, 1)
    (faulty,) = start(pool, 0.5, 2, fails="illegal access")
    (crashed,) = start(pool, 0.4, 3, fails="crash")
    assert [faulty.card, crashed.card] == [other.card for other in others]
    assert len({attempt.pid for attempt in (*others, faulty, crashed)}) == 4
    assert {attempt.card for attempt in others} == set(CARDS)
    ends = end(pool, faulty, crashed)
    assert all(isinstance(it, Failed) for it in ends)
    assert [(it.kind, it.reason[:41]) for it in ends if isinstance(it, Failed)] == [
        (Failure.ERROR, "AcceleratorError: CUDA error: an illegal "),
        (Failure.LOST, "the worker process died: killed or crashe"),
    ]
    (again,) = start(pool, 0.5, 2)
    assert again.card == faulty.card
    assert again.pid != faulty.pid
    assert all(works(pool, attempt) for attempt in [again, *others])
    wait_until(lambda: not any(map(psutil.pid_exists, (faulty.pid, crashed.pid))), "the end of both")
    assert end(pool, again, *others) == [Ended()] * 3


@pytest.mark.nightly
def test_parts_of_a_gpu_run_on_the_gpu_that_they_are_planned_for(pool: RayPool) -> None:
    """Ray alone puts both halves on one."""
    uuids = [gpu.uuid for gpu in pool.nodes()[0].gpus]
    one, other = (start(pool, 0.5, number, uuid=uuid)[0] for number, uuid in enumerate(uuids))
    assert [one.card, other.card] == uuids
    assert end(pool, one, other) == [Ended()] * 2


@pytest.mark.nightly
def test_a_whole_gpu_waits_for_parts_that_ray_has_spread(pool: RayPool) -> None:
    halves = start(pool, 0.5, 0, 1, 2, 3)
    first = {attempt.card: attempt for attempt in halves}
    assert set(first) == set(CARDS)
    assert end(pool, *first.values()) == [Ended()] * 2
    rest, whole = [attempt for attempt in halves if attempt not in first.values()], TaskId.block(4)
    pool.start(Placement(pool.nodes()[0].id, 0.25, 2**30, gpus=1.0, gpu=0), OnGpu(task=whole))
    assert pool.waiting(whole)  # so it does not count as one that hangs
    assert end(pool, *rest) == [Ended()] * 2
    assert isinstance(message(pool, whole), Hello)
    assert not pool.waiting(whole)
    pool.cancel(whole)
