"""Merges a run in a process that does nothing else, and says as JSON what that took: for `merge_scale`.

python -m benchmarks.merge_process RUN
"""

import json
import sys
import time
from pathlib import Path

from panolog.orchestrator.driver.merging import merge_run
from panolog.orchestrator.run.folder import RunFolder
from panolog.orchestrator.run.state import replay
from panolog.orchestrator.run.store import read_milestones
from panolog.partition.plan import read_plan


def merge(root: Path) -> dict[str, float]:
    """Seconds of the merge of a run, and peak memory of this process before and after it, in 1e6 bytes."""
    before, folder = peak(), RunFolder(root)
    started = time.perf_counter()
    plan = read_plan(folder.plan)
    merge_run(folder, replay(read_milestones(folder.database)), plan)
    return {"seconds": time.perf_counter() - started, "before": before, "peak": peak()}


def peak() -> float:
    """1e6 bytes that this process has had in memory at most; `getrusage` would count its parent's too."""
    lines = Path("/proc/self/status").read_text().splitlines()
    line = next(line for line in lines if line.startswith("VmHWM:"))
    return int(line.split()[1]) * 1024 / 1e6


if __name__ == "__main__":
    print(json.dumps(merge(Path(sys.argv[1]))))
