"""Which process is meant by a number: the boot of the machine and the moment of its start belong to it."""

from pathlib import Path

from panolog.orchestrator.runs.queue.entries import Identity

BOOT = Path("/proc/sys/kernel/random/boot_id")  # another one after each start of the machine
_STATE, _STARTED = 0, 19  # fields of /proc/PID/stat after the name of the program: proc_pid_stat(5)
_ENDED = ("Z", "X")  # states of processes that have ended and were not waited for


def identity(pid: int) -> Identity:
    """The identity of a process. Raises ProcessLookupError if it has ended, OSError without /proc."""
    stat = _stat(pid)
    if stat is None:
        raise ProcessLookupError(f"process {pid} has ended")
    return Identity(_boot(), pid, int(stat[_STARTED]))


def alive(process: Identity | None) -> bool:
    """Whether that process, and not another of its number, has not ended. Raises OSError as `identity`."""
    if process is None or process.boot != _boot():
        return False
    stat = _stat(process.pid)
    return stat is not None and int(stat[_STARTED]) == process.started


def _boot() -> str:
    return BOOT.read_text().strip()


def _stat(pid: int) -> list[str] | None:
    try:
        text = Path("/proc", str(pid), "stat").read_text(errors="replace")
    except (FileNotFoundError, ProcessLookupError):
        return None
    fields = text.rpartition(")")[2].split()  # a program's name may hold spaces and brackets
    return None if fields[_STATE] in _ENDED else fields
