"""Reads a run, live or ended, through what `panolog` prints as JSON: its state, its metrics, its loss curve.

python examples/read_run.py RUN
"""

import argparse
import json
import subprocess
from collections.abc import Sequence
from pathlib import Path


def main(arguments: Sequence[str] | None = None) -> None:
    """Prints what a run is, how far it is and how good."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("run", metavar="RUN", type=Path)
    run = parser.parse_args(arguments).run

    status = json.loads(printed("status", str(run), "--json"))
    print(f"{status['scene']} at {status['width']} pixels: {status['status']}")
    for task in status["tasks"]:
        print(f"{task['name']}: {task['status']}")
    if status["metrics"]:
        print(status["metrics"])
    for line in printed("events", str(run)).splitlines():
        event = json.loads(line)
        if event["type"] == "Progressed" and event["task"] == "coarse" and event["loss"] is not None:
            print(f"iteration {event['iteration']}: loss {event['loss']:.4f}")


def printed(*command: str) -> str:
    """What a command of PanoLOG prints; its errors go to stderr."""
    return subprocess.run(["panolog", *command], check=True, stdout=subprocess.PIPE, text=True).stdout


if __name__ == "__main__":
    main()
