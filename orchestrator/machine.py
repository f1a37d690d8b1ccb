"""What this machine has, without importing torch or Ray."""

import os
from pathlib import Path

_QUOTA = Path("/sys/fs/cgroup/cpu.max")  # "200000 100000" = two cores, "max 100000" = no limit


def cores(quota: Path = _QUOTA) -> int:
    """CPU cores that this process may use: its affinity, and a container's quota where there is one."""
    allowed = len(os.sched_getaffinity(0))
    if not quota.is_file():
        return allowed
    limit, period = quota.read_text().split()
    return allowed if limit == "max" else max(1, min(allowed, int(limit) // int(period)))
