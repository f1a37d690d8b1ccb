"""What this machine has, without importing torch or Ray."""

import os
import re
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path, PurePosixPath

import psutil

from panolog.orchestrator.runs.units import positive

_MOUNT = Path("/sys/fs/cgroup")  # of control groups: containers and services limit what their processes use
_OWN = Path("/proc/self/cgroup")  # lines "0::/group", of version 1 "4:memory:/group"
_VMSTAT = Path("/proc/vmstat")
_PRODUCT = Path("/sys/class/dmi/id/product_name")  # on AWS the instance type
_TYPE = re.compile(r"[a-z][a-z0-9-]*\.[a-z0-9-]+")  # other product names say nothing: "Standard PC", "KVM"
_INSTANCE = "PANOLOG_INSTANCE"  # the variable that names it where that does not
MEMORY_VARIABLE = "PANOLOG_MEMORY"  # GiB of this machine that a run may use
SHARE_VARIABLE = "PANOLOG_SHARE"  # the part of this machine that a run pays


def groups(controller: str) -> Iterator[Path]:
    """The folders of this process's control groups that may limit it, the innermost first.

    Of version 2, and of a controller of version 1 ("memory", "cpu"). In a container the mount may be the
    container's own group, below which its path on the machine does not exist: folders may be missing.
    """
    if not _OWN.is_file():
        return
    for line in _OWN.read_text().splitlines():
        _, controllers, path = line.split(":", 2)
        if not controllers or controller in controllers.split(","):
            base, inner = _MOUNT / (controller if controllers else ""), PurePosixPath(path.lstrip("/"))
            yield from (base / group for group in (inner, *inner.parents))


def cores() -> int:
    """CPU cores that this process may use: its affinity, and the quota of its control groups."""
    allowed = len(os.sched_getaffinity(0))
    for group in groups("cpu"):
        if text := _read(group / "cpu.max"):  # "200000 100000" = two cores, "max 100000" = no limit
            limit, period = text.split()
        else:
            limit, period = (_read(group / f"cpu.cfs_{name}_us") for name in ("quota", "period"))
        if limit.isdecimal():  # "" = no such file, "-1" = no limit
            allowed = min(allowed, int(limit) // int(period))
    return max(1, allowed)


def memory() -> int:
    """Bytes of memory that are free: the machine's, and within the limits of control groups.

    At most this run's share. Raises ConfigError if PANOLOG_MEMORY is no number.
    """
    return min([_free(), *_share()])


def memory_of_preparation() -> int:
    """Bytes of memory that the preparation of a scene may take: what is free, but for a fourth."""
    return memory() * 3 // 4


def memory_total() -> int:
    """Bytes of memory that this process's machine has, or its control groups may use; else as `memory`."""
    return min([_total(), *_share()])


def memory_usage() -> tuple[int, int]:
    """Bytes of memory in use on this machine or in its control groups, by all runs, and all there are."""
    total = _total()
    return max(0, total - _free()), total


def _free() -> int:
    free = [int(psutil.virtual_memory().available)]
    for group, limit in _limits():
        stat = _counts(group / "memory.stat")
        used = _read(group / "memory.current") or _read(group / "memory.usage_in_bytes")
        dropped = stat.get("total_inactive_file", stat.get("inactive_file", 0))  # version 1 has both
        free.append(limit - int(used) + dropped)
    return max(0, min(free))


def _total() -> int:
    return min([int(psutil.virtual_memory().total), *(limit for _, limit in _limits())])


def _share() -> Iterator[int]:
    """The bytes that a run may use of this machine, if that is limited."""
    if os.environ.get(MEMORY_VARIABLE):
        yield int(positive(MEMORY_VARIABLE, os.environ, 1.0, "a number of GiB, such as 12.5") * 2**30)


def _limits() -> Iterator[tuple[Path, int]]:
    """Control groups with their limits in bytes, those without one left out."""
    for group in groups("memory"):
        limit = _read(group / "memory.max") or _read(group / "memory.limit_in_bytes")
        if limit.isdecimal():  # not "max", and not "" = no such file
            yield group, int(limit)


def share() -> float:
    """The part of this machine that is this run's. Raises ConfigError if PANOLOG_SHARE is no number."""
    if os.environ.get(SHARE_VARIABLE) == "0":  # a run on the CPU next to those that have all GPUs
        return 0.0
    return min(1.0, positive(SHARE_VARIABLE, os.environ, 1.0, "the part of this machine that a run pays"))


def instance_type(product: Path = _PRODUCT) -> str:
    """The type of this machine as its provider calls it, such as g5.xlarge; "" if that cannot be seen."""
    given = os.environ.get(_INSTANCE, "").strip()
    try:
        named = given or product.read_text().strip()
    except (OSError, UnicodeDecodeError):
        return ""
    return named if given or _TYPE.fullmatch(named) else ""


def memory_of(title: str) -> int:
    """Bytes of memory that processes with this title hold alone."""
    held = 0
    for process in psutil.process_iter():
        with suppress(psutil.Error):  # it has ended, or is another user's
            if process.cmdline()[:1] == [title]:
                held += process.memory_full_info().uss
    return held


def oom_kills() -> int:
    """How many processes the kernel has killed for want of memory: in a control group, or on this machine."""
    around, names = groups("memory"), ("memory.events", "memory.oom_control")
    files = [group / name for group in around for name in names]
    for file in (*files, _VMSTAT):  # root groups have none
        if "oom_kill" in (counts := _counts(file)):
            return counts["oom_kill"]
    return 0


def _read(file: Path) -> str:
    return file.read_text().strip() if file.is_file() else ""


def _counts(file: Path) -> dict[str, int]:
    return {name: int(count) for name, count in map(str.split, _read(file).splitlines())}
