"""What a machine has within the limits of control groups, of version 2 and of version 1."""

import os
from pathlib import Path

import psutil
import pytest

from panolog.orchestrator.runs.machines import machine
from panolog.orchestrator.runs.machines.machine import cores, memory, memory_total, oom_kills

OWN = {1: "4:cpu,memory:/outer/inner\n0::/\n", 2: "0::/outer/inner\n"}
NONE = {1: "9223372036854771712", 2: "max"}  # no limit of memory


@pytest.fixture(autouse=True)
def mount(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Where control groups are mounted. Those of this process are not known before `belongs`."""
    for name in ("mount", "own", "vmstat"):
        monkeypatch.setattr(machine, f"_{name.upper()}", tmp_path / name)
    return tmp_path / "mount"


def belongs(mount: Path, version: int) -> None:
    mount.with_name("own").write_text(OWN[version])


def group(mount: Path, name: str, files: dict[str, str]) -> None:
    folder = mount / name
    folder.mkdir(parents=True, exist_ok=True)
    for file, content in files.items():
        (folder / file).write_text(f"{content}\n")


def limit(mount: Path, version: int, name: str, most: str, used: int) -> None:
    if version == 1:
        stat = "inactive_file 10\ntotal_inactive_file 250"
        files = {"memory.limit_in_bytes": most, "memory.usage_in_bytes": str(used), "memory.stat": stat}
        group(mount, f"memory/{name}", files)
    else:
        stat = "anon 350\ninactive_file 250"
        group(mount, name, {"memory.max": most, "memory.current": str(used), "memory.stat": stat})


@pytest.mark.parametrize("version", [1, 2])
@pytest.mark.parametrize("name", ["", "outer", "outer/inner"], ids=["container", "around", "own"])
def test_memory_is_what_a_control_group_leaves(mount: Path, version: int, name: str) -> None:
    belongs(mount, version)
    assert memory() == pytest.approx(psutil.virtual_memory().available, rel=0.5)
    limit(mount, version, name, NONE[version], 600)
    assert memory() > 2**20
    limit(mount, version, name, "1000", 600)
    assert memory() == 1000 - 600 + 250
    assert memory_total() == 1000
    limit(mount, version, name, "300", 600)
    assert memory() == 0


def test_the_narrowest_of_nested_groups_decides_and_without_a_limit_it_is_the_machines(mount: Path) -> None:
    whole = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    assert memory_total() == whole and 0 < memory() <= whole
    belongs(mount, 2)
    assert memory_total() == whole
    limit(mount, 2, "outer", "2000", 1900)
    limit(mount, 2, "outer/inner", "1000", 600)
    assert memory() == 2000 - 1900 + 250
    assert memory_total() == 1000


@pytest.mark.parametrize(
    ("version", "quota", "most"),
    [
        (2, "max 100000", 10**6),
        (2, "100000 100000", 1),
        (2, "50000 100000", 1),
        (1, "-1", 10**6),
        (1, "100000", 1),
    ],
)
def test_cores_respect_a_quota(mount: Path, version: int, quota: str, most: int) -> None:
    belongs(mount, version)
    older = {"cpu.cfs_quota_us": quota, "cpu.cfs_period_us": "100000"}
    group(mount, "cpu" if version == 1 else "outer", older if version == 1 else {"cpu.max": quota})
    assert cores() == min(most, len(os.sched_getaffinity(0)))


def test_kills_are_counted_in_the_group_or_on_the_machine(mount: Path) -> None:
    belongs(mount, 2)
    mount.with_name("vmstat").write_text("nr_free_pages 7\noom_kill 5\n")
    assert oom_kills() == 5
    group(mount, "outer", {"memory.events": "max 3\noom 2\noom_kill 1"})
    assert oom_kills() == 1
    content = "oom_kill_disable 0\nunder_oom 0\noom_kill 3"
    group(mount, "memory/outer/inner", {"memory.oom_control": content})
    belongs(mount, 1)
    assert oom_kills() == 3
