"""What a machine has within the limits of control groups, of version 2 and of version 1."""

import os
from pathlib import Path

import psutil
import pytest

from panolog.orchestrator.resources.machine import cores, memory, memory_total, oom_kills

V1, V2 = "4:cpu,memory:/outer/inner\n0::/\n", "0::/outer/inner\n"
MAX, CURRENT = (
    {1: "memory.limit_in_bytes", 2: "memory.max"},
    {1: "memory.usage_in_bytes", 2: "memory.current"},
)
STAT = {1: "inactive_file 10\ntotal_inactive_file 250\n", 2: "anon 350\ninactive_file 250\n"}
NONE = {1: "9223372036854771712", 2: "max"}


def own(tmp_path: Path, version: int) -> Path:
    file = tmp_path / "own"
    file.write_text(V1 if version == 1 else V2)
    return file


def group(tmp_path: Path, version: int, name: str, **files: str) -> None:
    folder = tmp_path / (f"mount/{'memory' if version == 1 else ''}") / name
    folder.mkdir(parents=True, exist_ok=True)
    for file, content in files.items():
        (folder / file.replace("__", ".")).write_text(content + "\n")


def limit(tmp_path: Path, version: int, name: str, most: str, used: int) -> None:
    group(tmp_path, version, name)
    folder = tmp_path / (f"mount/{'memory' if version == 1 else ''}") / name
    (folder / MAX[version]).write_text(most + "\n")
    (folder / CURRENT[version]).write_text(f"{used}\n")
    (folder / "memory.stat").write_text(STAT[version])


@pytest.mark.parametrize("version", [1, 2])
@pytest.mark.parametrize("name", ["", "outer", "outer/inner"], ids=["container", "around", "own"])
def test_memory_is_what_a_control_group_leaves(tmp_path: Path, version: int, name: str) -> None:
    mount, file = tmp_path / "mount", own(tmp_path, version)
    assert memory(mount, file) == pytest.approx(psutil.virtual_memory().available, rel=0.5)
    limit(tmp_path, version, name, NONE[version], 600)
    assert memory(mount, file) > 2**20
    limit(tmp_path, version, name, "1000", 600)
    assert memory(mount, file) == 1000 - 600 + 250
    assert memory_total(mount, file) == 1000
    limit(tmp_path, version, name, "300", 600)
    assert memory(mount, file) == 0


def test_the_narrowest_of_nested_groups_decides(tmp_path: Path) -> None:
    limit(tmp_path, 2, "outer", "2000", 1900)
    limit(tmp_path, 2, "outer/inner", "1000", 600)
    assert memory(tmp_path / "mount", own(tmp_path, 2)) == 2000 - 1900 + 250
    assert memory_total(tmp_path / "mount", own(tmp_path, 2)) == 1000


def test_without_a_limit_it_is_the_machines(tmp_path: Path) -> None:
    whole = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    assert memory_total(tmp_path, tmp_path / "none") == whole
    assert 0 < memory(tmp_path, tmp_path / "none") <= whole


@pytest.mark.parametrize(
    ("quota", "most"), [("max 100000", 10**6), ("100000 100000", 1), ("50000 100000", 1)]
)
def test_cores_respect_a_quota(tmp_path: Path, quota: str, most: int) -> None:
    group(tmp_path, 2, "outer", cpu__max=quota)
    assert cores(tmp_path / "mount", own(tmp_path, 2)) == min(most, len(os.sched_getaffinity(0)))


@pytest.mark.parametrize(("quota", "most"), [("-1", 10**6), ("100000", 1)])
def test_cores_respect_a_quota_of_version_1(tmp_path: Path, quota: str, most: int) -> None:
    folder = tmp_path / "mount" / "cpu"
    folder.mkdir(parents=True)
    (folder / "cpu.cfs_quota_us").write_text(quota + "\n")
    (folder / "cpu.cfs_period_us").write_text("100000\n")
    assert cores(tmp_path / "mount", own(tmp_path, 1)) == min(most, len(os.sched_getaffinity(0)))


def test_kills_are_counted_in_the_group_or_on_the_machine(tmp_path: Path) -> None:
    vmstat, mount = tmp_path / "vmstat", tmp_path / "mount"
    vmstat.write_text("nr_free_pages 7\noom_kill 5\n")
    assert oom_kills(mount, own(tmp_path, 2), vmstat) == 5
    group(tmp_path, 2, "outer", memory__events="max 3\noom 2\noom_kill 1")
    assert oom_kills(mount, own(tmp_path, 2), vmstat) == 1
    group(tmp_path, 1, "outer/inner", memory__oom_control="oom_kill_disable 0\nunder_oom 0\noom_kill 3")
    assert oom_kills(mount, own(tmp_path, 1), vmstat) == 3
