"""What the machines of a run do: measured next to the tasks, kept once for each machine."""

import json
import shutil
import socket
from collections.abc import Iterator
from dataclasses import asdict, replace
from pathlib import Path

import pytest

from panolog.orchestrator.runs.machines.gpus import GpuUsage
from panolog.orchestrator.runs.machines.usage import Usage, measure, with_usage
from panolog.orchestrator.runs.store import read_milestones
from panolog.orchestrator.watch.views import queries
from panolog.orchestrator.watch.views.history import History
from panolog.orchestrator.watch.views.run_view import view_run
from panolog.workers.events import Event
from panolog.workers.specs import TaskSpec
from tests.nvidia_smi import print_gpus
from tests.orchestrator.fakes import Harness, well

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
