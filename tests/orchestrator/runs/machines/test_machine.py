"""What a machine has within the limits of control groups, of version 2 and of version 1."""

import os
from pathlib import Path

import psutil
import pytest

from panolog.orchestrator.runs.machines.machine import cores, memory, memory_total, oom_kills

OWN = {1: "4:cpu,memory:/outer/inner\n0::/\n", 2: "0::/outer/inner\n"}
NONE = {1: "9223372036854771712", 2: "max"}  # no limit of memory
Places = tuple[Path, Path]  # where control groups are mounted, and the file that names those of this process


def places(tmp_path: Path, version: int) -> Places:
    (tmp_path / "own").write_text(OWN[version])
    return tmp_path / "mount", tmp_path / "own"


def group(of: Places, name: str, files: dict[str, str]) -> None:
    folder = of[0] / name
    folder.mkdir(parents=True, exist_ok=True)
    for file, content in files.items():
        (folder / file).write_text(f"{content}\n")


def limit(of: Places, version: int, name: str, most: str, used: int) -> None:
    if version == 1:
        stat = "inactive_file 10\ntotal_inactive_file 250"
        files = {"memory.limit_in_bytes": most, "memory.usage_in_bytes": str(used), "memory.stat": stat}
        group(of, f"memory/{name}", files)
    else:
        stat = "anon 350\ninactive_file 250"
        group(of, name, {"memory.max": most, "memory.current": str(used), "memory.stat": stat})


@pytest.mark.parametrize("version", [1, 2])
@pytest.mark.parametrize("name", ["", "outer", "outer/inner"], ids=["container", "around", "own"])
def test_memory_is_what_a_control_group_leaves(tmp_path: Path, version: int, name: str) -> None:
    of = places(tmp_path, version)
    assert memory(*of) == pytest.approx(psutil.virtual_memory().available, rel=0.5)
    limit(of, version, name, NONE[version], 600)
    assert memory(*of) > 2**20
    limit(of, version, name, "1000", 600)
    assert memory(*of) == 1000 - 600 + 250
    assert memory_total(*of) == 1000
    limit(of, version, name, "300", 600)
    assert memory(*of) == 0


def test_the_narrowest_of_nested_groups_decides_and_without_a_limit_it_is_the_machines(
    tmp_path: Path,
) -> None:
    of, whole = places(tmp_path, 2), os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    assert memory_total(*of) == memory_total(tmp_path, tmp_path / "none") == whole
    assert 0 < memory(tmp_path, tmp_path / "none") <= whole
    limit(of, 2, "outer", "2000", 1900)
    limit(of, 2, "outer/inner", "1000", 600)
    assert memory(*of) == 2000 - 1900 + 250
    assert memory_total(*of) == 1000


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
def test_cores_respect_a_quota(tmp_path: Path, version: int, quota: str, most: int) -> None:
    of, older = places(tmp_path, version), {"cpu.cfs_quota_us": quota, "cpu.cfs_period_us": "100000"}
    group(of, "cpu" if version == 1 else "outer", older if version == 1 else {"cpu.max": quota})
    assert cores(*of) == min(most, len(os.sched_getaffinity(0)))


def test_kills_are_counted_in_the_group_or_on_the_machine(tmp_path: Path) -> None:
    vmstat, of = tmp_path / "vmstat", places(tmp_path, 2)
    vmstat.write_text("nr_free_pages 7\noom_kill 5\n")
    assert oom_kills(*of, vmstat) == 5
    group(of, "outer", {"memory.events": "max 3\noom 2\noom_kill 1"})
    assert oom_kills(*of, vmstat) == 1
    content = "oom_kill_disable 0\nunder_oom 0\noom_kill 3"
    group(of, "memory/outer/inner", {"memory.oom_control": content})
    assert oom_kills(*places(tmp_path, 1), vmstat) == 3
