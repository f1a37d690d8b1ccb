"""What each run of a queue has of the machine: GPUs that are its own, cores, and a limit of memory.

A run that states no needs has an even part of the machine, by the number of runs that may be side by side.
With one at a time, nothing is divided: it has what `panolog run` has.
"""

import json
import os
from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from panolog.orchestrator.runs.folder import RunFolder
from panolog.orchestrator.runs.machines import machine
from panolog.orchestrator.runs.machines.gpus import gpus_to_share
from panolog.orchestrator.runs.queue.entries import Entry, Needs, Share
from panolog.orchestrator.runs.units import counted, gib

_EVEN = 0.9  # of the memory is divided evenly; the rest is for the system, drivers and Ray


class NeverFitsError(Exception):
    """A run needs more than the machine has. The message is a line for people."""


@dataclass(frozen=True)
class Capacity:
    gpus: tuple[str, ...]  # as CUDA_VISIBLE_DEVICES calls them; () if none are known
    cores: tuple[int, ...]
    memory: int  # bytes

    @staticmethod
    def own() -> "Capacity":
        """What this process may use. Raises ConfigError if PANOLOG_MEMORY is no number."""
        cores = sorted(os.sched_getaffinity(0))[: machine.cores()]
        return Capacity(gpus_to_share(), tuple(cores), machine.memory_total())

    def wanted(self, entry: Entry, at_once: int) -> Needs | None:
        """What an entry is to get: as stated, else an even part, but memory for the largest task that its
        preflight has foreseen, if it has one. None in it: all, undivided. None: it is on a cluster.

        Raises NeverFitsError.
        """
        stated = entry.command.needs
        if stated is None:
            return None
        gpus, cores, memory = stated.gpus, stated.cores, stated.memory
        if at_once > 1:
            if gpus is None and self.gpus:
                gpus = max(1, len(self.gpus) // at_once)
            cores = cores or max(1, len(self.cores) // at_once)
            even = int(_EVEN * self.memory) // at_once
            memory = memory or min(self.memory, max(even, _foreseen(entry.command.run)))
        if gpus is not None and gpus > len(self.gpus):
            raise NeverFitsError(f"needs {counted(gpus, 'GPU')}; this machine has {len(self.gpus)}")
        if cores is not None and cores > len(self.cores):
            raise NeverFitsError(f"needs {counted(cores, 'core')}; this machine has {len(self.cores)}")
        if memory is not None and memory > self.memory:
            raise NeverFitsError(f"needs {gib(memory)} of memory; this machine has {gib(self.memory)}")
        return Needs(gpus, cores, memory)

    def share(self, wanted: Needs, held: Sequence[Share], at_once: int) -> Share | str:
        """What of the machine a run gets next to others, or what it waits for, in one line."""
        free = [gpu for gpu in self.gpus if all(it.gpus is not None and gpu not in it.gpus for it in held)]
        left = self.memory - sum(self.memory if it.memory is None else it.memory for it in held)
        use = Counter(core for it in held for core in (self.cores if it.cores is None else it.cores))
        together = -(-at_once // len(self.cores))  # runs on one core, if they are more than the cores
        cores = sorted((core for core in self.cores if use[core] < together), key=lambda core: use[core])
        if wanted.gpus and len(free) < wanted.gpus:
            return f"waits for {counted(wanted.gpus, 'GPU')}: {len(free)} of {len(self.gpus)} free"
        if wanted.cores and len(cores) < wanted.cores:
            return f"waits for {counted(wanted.cores, 'core')}: {len(cores)} of {len(self.cores)} free"
        if wanted.memory and left < wanted.memory:
            return f"waits for {gib(wanted.memory)} of memory: {gib(max(0, left))} free"
        return Share(
            None if wanted.gpus is None else tuple(free[: wanted.gpus]),
            None if wanted.cores is None else tuple(sorted(cores[: wanted.cores])),
            wanted.memory,
        )


def environment(share: Share | None, whole: Capacity) -> dict[str, str]:
    """The variables that limit a run to its share, and say what it pays.

    Its cores are the affinity of its process.
    """
    if share is None:
        return {}
    values = {} if share.gpus is None else {"CUDA_VISIBLE_DEVICES": ",".join(share.gpus)}
    values |= {} if share.memory is None else {machine.MEMORY_VARIABLE: repr(share.memory / 2**30)}
    mine, every = (share.gpus, whole.gpus) if whole.gpus else (share.cores, whole.cores)
    return values | ({} if mine is None else {machine.SHARE_VARIABLE: f"{len(mine) / len(every):g}"})


def describe(entry: Entry) -> str:
    """What an entry has of the machine, or is to get as stated, for people; "" if neither is known."""
    if (share := entry.share) is not None:
        gpus = None if share.gpus is None else len(share.gpus)
        cores = None if share.cores is None else len(share.cores)
        return _words(Needs(gpus, cores, share.memory))
    return _words(entry.command.needs or Needs())


def _words(needs: Needs) -> str:
    gpus = counted(needs.gpus, "GPU") if needs.gpus else ""
    cores = counted(needs.cores, "core") if needs.cores else ""
    return ", ".join(filter(None, (gpus, cores, gib(needs.memory) if needs.memory else "")))


def _foreseen(run: Path) -> int:
    """Bytes of main memory of the largest task of a run that its preflight has foreseen; 0 if it has none."""
    with suppress(OSError, ValueError, KeyError, TypeError):
        stages = json.loads(RunFolder(run).preflight.read_bytes())["estimate"]["stages"]
        return max(int(stage["host"]) for stage in stages)
    return 0
