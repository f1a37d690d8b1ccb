"""The machines of a run: their GPUs, and what they do, measured next to the tasks."""

import json
import shutil
import socket
from collections.abc import Iterator
from dataclasses import asdict, replace
from pathlib import Path

import pytest

from panolog.orchestrator.runs.database import read_milestones
from panolog.orchestrator.runs.machines import gpus
from panolog.orchestrator.runs.machines.gpus import GpuUsage, describe_gpus
from panolog.orchestrator.runs.machines.nodes import Gpu, Node
from panolog.orchestrator.runs.machines.usage import Usage, measure, with_usage
from panolog.orchestrator.watch.views import queries
from panolog.orchestrator.watch.views.history import History
from panolog.orchestrator.watch.views.run_view import view_run
from panolog.workers.events import Event
from panolog.workers.specs import TaskSpec
from tests.nvidia_smi import print_gpus
from tests.orchestrator.fakes import Harness, SetClock, well

MIB = 2**20
GPU = GpuUsage("NVIDIA H100", 0.87, 40_000 * MIB, 81_559 * MIB)
HERE = Usage("node", 0.5, 3, 8, 1, 4, (GPU,))
LISTING = "NVIDIA H100, 87, 40000, 81559\nNVIDIA H100 MIG, [N/A], [N/A], 9856\n"


def test_this_machine_is_measured(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    listing = print_gpus(tmp_path, monkeypatch, LISTING)
    usage = measure()
    assert usage.node == socket.gethostname()
    assert 0 <= usage.cpu <= 1
    assert 0 < usage.memory_used < usage.memory_total
    assert 0 < usage.disk_used < usage.disk_total
    assert usage.gpus == (GPU, GpuUsage("NVIDIA H100 MIG", None, None, 9856 * MIB))
    listing.unlink()  # the program fails
    assert measure().gpus == ()


def test_measurements_come_between_the_events_of_a_task() -> None:
    messages = with_usage(iter(int, 1), first=0.0)
    assert any(isinstance(message, Usage) for message in messages)
    assert list(with_usage([1, 2], first=60.0)) == [1, 2]


def measuring(spec: TaskSpec) -> Iterator[Event]:
    for event in well(spec):
        yield event
        yield from (HERE, replace(HERE, node=socket.gethostname()))  # type: ignore[misc]


def test_the_driver_keeps_one_measurement_of_each_machine(harness: Harness) -> None:
    harness.drive(measuring)
    database = harness.folder.database
    kept = queries.usages(database)
    disk = shutil.disk_usage(harness.folder.root).total  # here that of the run counts
    sizes = {node: usage["disk_total"] for node, usage in kept.items()}
    assert sizes == {"node": HERE.disk_total, socket.gethostname(): disk}
    records = read_milestones(database)
    assert not any("Usage" in type(item.record).__name__ for item in records)
    live = view_run(History.of(records), {}, running=True, usages=kept)
    (node,) = live.nodes
    assert node.usage is not None
    assert node.usage.time > 0
    shown = node.usage.model_dump(mode="json", exclude={"time"})
    assert shown | {"node": "node"} == json.loads(json.dumps(asdict(HERE)))
    at_rest = view_run(History.of(records), {}, running=False, usages=kept)
    assert at_rest.nodes[0].usage is None


MIB = 2**20
LARGE = Gpu("NVIDIA RTX 4090", 24_000 * MIB, "GPU-aa11")
SMALL = Gpu("NVIDIA RTX 3060", 11_000 * MIB, "GPU-bb22")
CARDS = "0, GPU-aa11, NVIDIA RTX 4090, 24000, 24564\n1, GPU-bb22, NVIDIA RTX 3060, 11000, 11500\n"


@pytest.fixture
def listing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """What `nvidia-smi` prints here."""
    return print_gpus(tmp_path, monkeypatch, CARDS)


@pytest.mark.parametrize(
    ("visible", "gpus"),
    [
        ("", (LARGE, SMALL)),
        ("0,1", (LARGE, SMALL)),
        ("1,0", (SMALL, LARGE)),
        ("1", (SMALL,)),
        ("GPU-aa", (LARGE,)),
    ],
)
def test_gpus_are_described_as_cuda_counts_them(
    listing: Path, monkeypatch: pytest.MonkeyPatch, visible: str, gpus: tuple[Gpu, ...]
) -> None:
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", visible)
    assert describe_gpus(len(gpus)) == gpus


def test_where_nothing_says_which_are_ours_the_least_is_assumed(listing: Path) -> None:
    assert describe_gpus(1) == (Gpu(SMALL.name, SMALL.memory),)


@pytest.mark.parametrize(
    "output", ["", "No devices were found\n", "0, GPU-aa11, NVIDIA RTX 4090, [N/A], [N/A]\n"]
)
def test_gpus_of_which_nothing_is_known(listing: Path, output: str) -> None:
    listing.write_text(output)
    assert describe_gpus(2) == (Gpu(), Gpu())
    listing.unlink()  # the program fails
    assert describe_gpus(2) == (Gpu(), Gpu())


def test_without_gpus_no_program_is_needed(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    assert describe_gpus(0) == ()
    assert describe_gpus(1) == (Gpu(),)


def test_a_card_is_known_by_its_uuid_or_by_its_place() -> None:
    machine = Node("a", "host", 8, 2**30, (LARGE, Gpu("MIG 1g")))
    assert [machine.card(gpu) for gpu in range(2)] == [LARGE.uuid, "a/1"]


@pytest.mark.parametrize(
    ("measured", "memory"), [([2_000, 9_000, 24_000], 24_000), ([9_000, 9_000], 9_000)], ids=["dying", "kept"]
)
def test_memory_that_dying_workers_still_hold_counts_as_free_and_what_others_keep_does_not(
    monkeypatch: pytest.MonkeyPatch, measured: list[int], memory: int
) -> None:
    free = iter(measured)
    monkeypatch.setattr(gpus, "time", SetClock())
    row = ["0", "GPU-aa11", "NVIDIA RTX 4090"]
    monkeypatch.setattr(gpus, "nvidia_smi", lambda _: [[*row, str(next(free)), "24564"]])
    assert describe_gpus(1) == (replace(LARGE, memory=memory * MIB),)
    assert not list(free)
