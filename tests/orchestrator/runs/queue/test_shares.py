"""What each run of a queue gets of the machine: never one GPU twice, in order, and no more than there is."""

import json
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import psutil
import pytest

from panolog.orchestrator.runs.folder import RunFolder
from panolog.orchestrator.runs.machines.machine import memory, memory_total, memory_usage
from panolog.orchestrator.runs.queue.database import Queue
from panolog.orchestrator.runs.queue.entries import Command, Entry, Needs, Share, State
from panolog.orchestrator.runs.queue.shares import Capacity, NeverFitsError, describe, environment
from panolog.orchestrator.runs.queue.view import view_queue
from panolog.scene.errors import ConfigError
from tests.nvidia_smi import print_gpus
from tests.orchestrator.runs.queue.queues import ANY, Scripted
from tests.orchestrator.runs.queue.test_runner import ended
from tests.ray_head import wait_until

GIB = 2**30
FOUR = Capacity(("GPU-a", "GPU-b", "GPU-c", "GPU-d"), tuple(range(16)), 100 * GIB)
BARE = Capacity((), (0, 1), 20 * GIB)


def entry(needs: Needs | None = ANY, run: Path = Path("/run")) -> Entry:
    return Entry(1, 1, State.WAITING, Command(run, (), (), Path("/"), needs), 0.0)


@pytest.mark.parametrize(
    ("machine", "needs", "at_once", "wanted"),
    [
        (FOUR, Needs(), 1, Needs()),
        (FOUR, Needs(gpus=1), 1, Needs(gpus=1)),
        (FOUR, Needs(), 4, Needs(1, 4, int(22.5 * GIB))),
        (FOUR, Needs(), 3, Needs(1, 5, 30 * GIB)),
        (FOUR, Needs(), 64, Needs(1, 1, int(0.9 * 100 * GIB) // 64)),
        (FOUR, Needs(3, 8, 99 * GIB), 2, Needs(3, 8, 99 * GIB)),
        (FOUR, Needs(gpus=0), 2, Needs(0, 8, 45 * GIB)),
        (FOUR, None, 2, None),
        (BARE, Needs(), 2, Needs(None, 1, 9 * GIB)),  # of its GPUs nothing is known
    ],
)
def test_what_is_not_stated_is_an_even_part(
    machine: Capacity, needs: Needs | None, at_once: int, wanted: Needs | None
) -> None:
    assert machine.wanted(entry(needs), at_once) == wanted


def test_memory_that_a_preflight_has_foreseen_counts(tmp_path: Path) -> None:
    stages = [{"host": 3 * GIB}, {"host": 60 * GIB}]
    RunFolder(tmp_path).preflight.write_text(json.dumps({"estimate": {"stages": stages}}))
    assert FOUR.wanted(entry(run=tmp_path), 4) == Needs(1, 4, 60 * GIB)
    assert FOUR.wanted(entry(Needs(memory=30 * GIB), tmp_path), 4) == Needs(1, 4, 30 * GIB)
    RunFolder(tmp_path).preflight.write_text("{")
    assert FOUR.wanted(entry(run=tmp_path), 4) == Needs(1, 4, int(22.5 * GIB))


@pytest.mark.parametrize(
    ("machine", "needs", "line"),
    [
        (FOUR, Needs(gpus=5), "needs 5 GPUs; this machine has 4"),
        (BARE, Needs(gpus=1), "needs 1 GPU; this machine has 0"),
        (FOUR, Needs(cores=17), "needs 17 cores; this machine has 16"),
        (FOUR, Needs(memory=101 * GIB), "needs 101.0 GiB of memory; this machine has 100.0 GiB"),
    ],
)
def test_more_than_the_machine_has_never_fits(machine: Capacity, needs: Needs, line: str) -> None:
    for at_once in (1, 2):
        with pytest.raises(NeverFitsError, match=line):
            machine.wanted(entry(needs), at_once)


def test_shares_are_disjoint_until_nothing_is_left() -> None:
    held: list[Share] = []
    for gpus in (("GPU-a",), ("GPU-b",), ("GPU-c",), ("GPU-d",)):
        wanted = FOUR.wanted(entry(), 4)
        share = FOUR.share(wanted or Needs(), held, 4)
        assert isinstance(share, Share)
        assert share.gpus == gpus
        held.append(share)
    assert sorted(core for share in held for core in share.cores or ()) == list(range(16))
    assert FOUR.share(Needs(1, 4, GIB), held, 4) == "waits for 1 GPU: 0 of 4 free"
    assert FOUR.share(Needs(0, 4, GIB), held, 4) == "waits for 4 cores: 0 of 16 free"
    del held[1]
    assert FOUR.share(Needs(1, 4, 40 * GIB), held, 4) == "waits for 40.0 GiB of memory: 32.5 GiB free"
    assert FOUR.share(Needs(1, 2, GIB), held, 4) == Share(("GPU-b",), (4, 5), GIB)
    undivided = [Share()]
    assert FOUR.share(Needs(1, 1, GIB), undivided, 2) == "waits for 1 GPU: 0 of 4 free"


def test_more_runs_than_cores_share_them() -> None:
    held: list[Share] = []
    for core in (0, 1, 0, 1):
        share = BARE.share(Needs(None, 1, GIB), held, 3)
        assert isinstance(share, Share)
        assert share.cores == (core,)
        held.append(share)
    assert BARE.share(Needs(None, 1, GIB), held, 3) == "waits for 1 core: 0 of 2 free"


def test_a_share_in_words_and_variables() -> None:
    share = Share(("GPU-a", "GPU-c"), (0,), 3 * GIB // 2)
    limits = {"CUDA_VISIBLE_DEVICES": "GPU-a,GPU-c", "PANOLOG_MEMORY": "1.5"}
    assert environment(share, FOUR) == {**limits, "PANOLOG_SHARE": "0.5"}
    assert environment(Share(None, (0,), None), BARE) == {"PANOLOG_SHARE": "0.5"}
    assert environment(Share((), None, None), FOUR) == {"CUDA_VISIBLE_DEVICES": "", "PANOLOG_SHARE": "0"}
    assert environment(Share(), FOUR) == environment(None, FOUR) == {}
    assert describe(replace(entry(), share=share)) == "2 GPUs, 1 core, 1.5 GiB"
    assert describe(entry(Needs(0, 3))) == "3 cores"
    assert describe(entry()) == describe(entry(None)) == ""


def test_a_run_counts_on_its_share_of_the_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    used, total = memory_usage()
    assert 0 < used < total == memory_total()
    monkeypatch.setenv("PANOLOG_MEMORY", "0.25")
    assert memory() == memory_total() == GIB // 4
    assert memory_usage()[1] == total
    monkeypatch.setenv("PANOLOG_MEMORY", "much")
    with pytest.raises(ConfigError, match=r"PANOLOG_MEMORY=much: write a number of GiB, such as 12\.5"):
        memory()


def test_four_gpus_are_given_out_in_order(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A large run gets its turn, one that never fits fails, and no GPU is in two runs."""
    print_gpus(tmp_path, monkeypatch, "".join(f"{i}, GPU-{i}, NVIDIA L4, 22000, 23000\n" for i in range(4)))
    queue = Scripted(tmp_path, at_once=4)
    for name, gpus in (("a", 2), ("b", 1), ("c", 2), ("d", 5), ("e", 1)):
        queue.add(name, needs=Needs(gpus), held=True)
    runner = queue.start()
    wait_until(lambda: queue.entries()[2].reason != "", "what the third waits for")
    assert queue.entries()[2].reason == "waits for 2 GPUs: 1 of 4 free"
    assert queue.states() == [State.RUNNING] * 2 + [State.WAITING] * 3  # nothing overtakes
    with closing(Queue(queue.folder)) as opened:
        first, _, third, *_ = view_queue(opened).lines()
    assert first.startswith(f"1  running      {tmp_path}/a  (2 GPUs, ")
    assert third.endswith("/c  (waits for 2 GPUs: 1 of 4 free)")
    (tmp_path / "a" / "wait").unlink()
    wait_until(lambda: all(map(queue.share, "abce")), "the start of all that have a turn")
    assert queue.states() == [State.DONE, State.RUNNING, State.RUNNING, State.FAILED, State.RUNNING]
    assert queue.entries()[3].reason == "needs 5 GPUs; this machine has 4"
    names = {name: queue.share(name)["CUDA_VISIBLE_DEVICES"] for name in "abce"}
    assert names == {"a": "GPU-0,GPU-1", "b": "GPU-2", "c": "GPU-0,GPU-1", "e": "GPU-3"}
    part = 0.9 * psutil.virtual_memory().total / GIB / 4
    assert all(0 < float(queue.share(name)["PANOLOG_MEMORY"]) <= part for name in "abce")
    share = queue.entries()[1].share
    assert share is not None
    assert (share.gpus, share.cores) == (("GPU-2",), tuple(queue.share("b")["cores"]))
    for name in "bce":
        (tmp_path / name / "wait").unlink()
    code, said = ended(runner)
    assert code == 1
    assert queue.entries()[2].reason == ""
    assert "3: waits for 2 GPUs: 1 of 4 free" in said
