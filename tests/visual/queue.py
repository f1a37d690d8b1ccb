"""A queue as a runner leaves it in the middle of its work, for the page of all runs."""

import os
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path

from panolog.orchestrator.runs import lock
from panolog.orchestrator.runs.queue.entries import Command, Needs, Share, State
from panolog.orchestrator.runs.queue.processes import Processes
from panolog.orchestrator.runs.queue.runner import lock_of
from panolog.orchestrator.runs.queue.store import Queue
from tests.visual.fixed import Clock
from tests.visual.runs import NAMES

_FAILED = "depot: sparse/0/images.bin: names 12 panoramas that are not in images/; remove them from the model"


@contextmanager
def queue_at_work(root: Path, runs: Path, clock: Clock) -> Iterator[Path]:
    """The folder of a queue in which one run has failed, one is at work and three wait."""
    folder, now = root / "queue", clock.now
    with closing(Queue(folder)) as queue:
        clock.now = now - 9_000
        for name in ("depot", NAMES["live"], "canal", "north-gate", "station-2026-03-14-second-visit"):
            run = runs / name
            needs = Needs(gpus=4 if name == "canal" else None)
            queue.add(Command(run, (f"/data/scenes/{name}", "--output", str(run)), (), root, needs))
        queue.claim(1)
        clock.now = now - 8_400
        queue.end(1, State.FAILED, 2, _FAILED)
        queue.claim(2)
        share = Share(("GPU-5a", "GPU-5b"), tuple(range(16)), 56 * 2**30)
        queue.launched(2, Processes().identity(os.getpid()), share)
        queue.note(3, "waits for 4 GPUs: 2 of 4 free")
    clock.now = now
    with lock.hold(lock_of(folder)):
        yield folder
