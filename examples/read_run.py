"""Reads a run folder, live or ended: its state, its metrics and the loss curve of Stage I.

python examples/read_run.py RUN
"""

import argparse
import json
from collections.abc import Sequence
from pathlib import Path

from panolog.orchestrator.runs import lock
from panolog.orchestrator.runs.folder import RunFolder
from panolog.orchestrator.runs.info import read_info
from panolog.orchestrator.runs.state import replay
from panolog.orchestrator.runs.store import read_milestones
from panolog.orchestrator.watch.views.queries import series


def main(arguments: Sequence[str] | None = None) -> None:
    """Prints what a run is, how far it is and how good."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("run", metavar="RUN", type=Path)
    folder = RunFolder(parser.parse_args(arguments).run)

    info = read_info(folder)
    print(f"{info.scene.path}: {info.config.iterations} iterations, blocks {info.config.blocks}")
    state = replay(read_milestones(folder.database))
    print("a driver is running" if lock.held(folder.lock) else state.outcome or "stopped")
    for name, task in sorted(state.tasks.items()):
        print(f"{name}: {task.status}")
    if folder.metrics.exists():
        print(json.loads(folder.metrics.read_text())["mean"])
    curve = series(folder.database, "coarse", points=10)["loss"]
    for iteration, loss in zip(curve["iteration"], curve["value"], strict=True):
        print(f"iteration {iteration:.0f}: loss {loss:.4f}")


if __name__ == "__main__":
    main()
