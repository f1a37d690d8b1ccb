from dataclasses import replace
from pathlib import Path

import pytest

from panolog.orchestrator.runs.machines import gpus
from panolog.orchestrator.runs.machines.gpus import describe_gpus
from panolog.orchestrator.runs.machines.nodes import Gpu, Node
from tests.nvidia_smi import print_gpus
from tests.orchestrator.fakes import SetClock

MIB = 2**20
LARGE = Gpu("NVIDIA RTX 4090", 24_000 * MIB, "GPU-aa11")
SMALL = Gpu("NVIDIA RTX 3060", 11_000 * MIB, "GPU-bb22")
LISTING = "0, GPU-aa11, NVIDIA RTX 4090, 24000, 24564\n1, GPU-bb22, NVIDIA RTX 3060, 11000, 11500\n"


@pytest.fixture
def listing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """What `nvidia-smi` prints here."""
    return print_gpus(tmp_path, monkeypatch, LISTING)


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


def test_where_nobody_says_which_are_ours_the_least_is_assumed(listing: Path) -> None:
    assert describe_gpus(1) == (Gpu(SMALL.name, SMALL.memory),)


@pytest.mark.parametrize(
    "output", ["", "No devices were found\n", "0, GPU-aa11, NVIDIA RTX 4090, [N/A], [N/A]\n"]
)
def test_gpus_of_which_nothing_is_known(listing: Path, output: str) -> None:
    listing.write_text(output)
    assert describe_gpus(2) == (Gpu(), Gpu())
    listing.unlink()  # the program fails
    assert describe_gpus(2) == (Gpu(), Gpu())


def test_without_gpus_nobody_is_asked(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
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
