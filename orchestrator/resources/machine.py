"""What this machine has, without importing torch or Ray."""

import os
from contextlib import suppress
from pathlib import Path

import psutil

_CGROUP = Path("/sys/fs/cgroup")  # version 2: of the container that this process is in
_VMSTAT = Path("/proc/vmstat")
_QUOTA = _CGROUP / "cpu.max"  # "200000 100000" = two cores, "max 100000" = no limit


def cores(quota: Path = _QUOTA) -> int:
    """CPU cores that this process may use: its affinity, and a container's quota where there is one."""
    allowed = len(os.sched_getaffinity(0))
    if not quota.is_file():
        return allowed
    limit, period = quota.read_text().split()
    return allowed if limit == "max" else max(1, min(allowed, int(limit) // int(period)))


def memory(cgroup: Path = _CGROUP) -> int:
    """Bytes of memory that are free: the machine's, and within a container's limit where there is one."""
    free = int(psutil.virtual_memory().available)
    limit = cgroup / "memory.max"  # bytes, or "max" = none; the root group has no such file
    if not limit.is_file() or (most := limit.read_text().strip()) == "max":
        return free
    stat = dict(line.split() for line in (cgroup / "memory.stat").read_text().splitlines())
    used = int((cgroup / "memory.current").read_text()) - int(stat["inactive_file"])  # files can be dropped
    return max(0, min(free, int(most) - used))


def memory_total(cgroup: Path = _CGROUP) -> int:
    """Bytes of memory that this process's machine has, or its container may use."""
    total = int(psutil.virtual_memory().total)
    limit = cgroup / "memory.max"
    most = limit.read_text().strip() if limit.is_file() else "max"
    return total if most == "max" else min(total, int(most))


def memory_of(title: str) -> int:
    """Bytes of memory that processes with this title hold alone."""
    held = 0
    for process in psutil.process_iter():
        with suppress(psutil.Error):  # it has ended, or is another user's
            if process.cmdline()[:1] == [title]:
                held += process.memory_full_info().uss
    return held


def oom_kills(cgroup: Path = _CGROUP, vmstat: Path = _VMSTAT) -> int:
    """How many processes the kernel has killed for want of memory: in this container, or on this machine."""
    events = cgroup / "memory.events"  # the root group has no such file
    file = events if events.is_file() else vmstat
    counts = dict(line.split() for line in file.read_text().splitlines())
    return int(counts.get("oom_kill", 0))
