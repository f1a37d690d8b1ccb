"""What preflight expects of a run beside what the run then takes: memory and time, stage by stage.

    python -m benchmarks.preflight [--data FOLDER] [--iterations 300] [--width 256] [--folder FOLDER] [--json]

Three scenes: a street and a flat from the folder with test data (by default ../shared/data beside the
checkout), where they are there, and the demo's town, made anew. Each run calibrates itself just before it
begins, so both sides see the machine as it is at that time; if it has something else to do at one of them and
not at the other, that is what the times show. The goal is 15% of memory and 25% of time.
"""

import argparse
import json
import os
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from benchmarks.report import machine
from benchmarks.runs import history, panolog, stage_seconds
from benchmarks.table import markdown
from panolog.orchestrator.run.folder import RunFolder
from panolog.orchestrator.run.records import Progressed
from panolog.scene.errors import PanologError
from panolog.synthetic.make import make_town

DATA = Path(__file__).resolve().parents[2] / "shared" / "data"
SHARED = ("street", "flat")
HEAD = ("scene", "stage", "Gaussians", "", "MiB", "", "error", "seconds", "", "error")
WHOLE = "all"
MEMORY, TIME = 0.15, 0.25  # the goals, as fractions


@dataclass(frozen=True)
class Row:
    """One stage of a scene, or the whole run; expected, then measured."""

    scene: str
    stage: str
    gaussians: tuple[int | None, int | None]
    memory: tuple[int, int]  # bytes: the peak of a worker's process, or of a task on its GPU
    seconds: tuple[float, float]

    @property
    def memory_error(self) -> float:
        """Of the expectation, as a fraction of what was measured."""
        return self.memory[0] / self.memory[1] - 1

    @property
    def time_error(self) -> float:
        """The same of the time."""
        return self.seconds[0] / self.seconds[1] - 1


def compare(name: str, root: Path) -> list[Row]:
    """The stages of a finished run that have tasks, and all of it."""
    expected = json.loads(RunFolder(root).preflight.read_bytes())["estimate"]
    records = history(root)
    seconds = stage_seconds(records)
    seconds["score"] = seconds.get("score", 0.0) + seconds.get("plan", 0.0)
    progress = [stored.record for stored in records if isinstance(stored.record, Progressed)]
    rows = [
        Row(
            name,
            stage["name"],
            (stage["gaussians"], max(p.gaussians or 0 for p in of_stage)),
            _peaks(stage, of_stage),
            (stage["seconds"], seconds[stage["name"]]),
        )
        for stage in expected["stages"]
        if (of_stage := [p for p in progress if p.task.partition("/")[0] == stage["name"]])
    ]
    memory = (max(row.memory[0] for row in rows), max(row.memory[1] for row in rows))
    total = sum(value for key, value in seconds.items() if key != "plan")
    return [*rows, Row(name, WHOLE, (None, None), memory, (expected["seconds"], total))]


def _peaks(stage: dict[str, Any], progress: Sequence[Progressed]) -> tuple[int, int]:
    """Bytes, expected and measured: of the GPU where there is one."""
    if stage["device"]:
        return stage["device"], max(p.memory or 0 for p in progress)
    return stage["host"], max(p.host_peak or 0 for p in progress)


def scenes(data: Path, folder: Path) -> dict[str, Path]:
    """Those there are, by name; the town is made in `folder`."""
    found = {name: data / name for name in SHARED if (data / name).is_dir()}
    return found | {"town": make_town(folder / "town")}


def table(rows: Sequence[Row]) -> str:
    """For the note."""
    mebi = 2**20
    return markdown(
        HEAD,
        [
            (
                row.scene,
                row.stage,
                *row.gaussians,
                *(round(value / mebi) for value in row.memory),
                f"{row.memory_error:+.0%}",
                *row.seconds,
                f"{row.time_error:+.0%}",
            )
            for row in rows
        ],
    )


def verdict(rows: Sequence[Row]) -> str:
    """Which scenes keep to the goals."""
    whole = [row for row in rows if row.stage == WHOLE]
    memory = sum(abs(row.memory_error) <= MEMORY for row in whole)
    time = sum(abs(row.time_error) <= TIME for row in whole)
    return f"of {len(whole)} scenes, memory within {MEMORY:.0%} in {memory}, time within {TIME:.0%} in {time}"


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the scenes and prints the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--data", type=Path, default=DATA, help="folder of the scenes street and flat")
    parser.add_argument("--iterations", type=int, default=300, help="of Stage I and of each block")
    parser.add_argument("--width", type=int, default=256, help="pixels")
    parser.add_argument("--folder", type=Path, help="keep the runs here, a folder that does not exist yet")
    parser.add_argument("--json", action="store_true", help="numbers instead of a table")
    options = parser.parse_args(arguments)
    with tempfile.TemporaryDirectory() as temporary:
        folder = options.folder or Path(temporary) / "runs"
        folder.mkdir(parents=True)
        try:
            rows = [
                row
                for name, scene in scenes(options.data, folder).items()
                for row in _run(name, scene, folder / f"run-{name}", options)
            ]
        except PanologError as error:
            print(error, file=sys.stderr)
            return 1
    if options.json:
        print(json.dumps([asdict(row) for row in rows], indent=2))
    else:
        print(f"{machine()}; {options.width} pixels, {options.iterations} iterations")
        print(f"load of this machine in the last 15 minutes: {os.getloadavg()[2]:.1f}")
        print("each pair: expected, measured\n")
        print(table(rows))
        print(verdict(rows))
    return 0


def _run(name: str, scene: Path, root: Path, options: argparse.Namespace) -> list[Row]:
    settings = ["--iterations", str(options.iterations), "--width", str(options.width)]
    panolog("run", str(scene), "-o", str(root), *settings, "--set", "sky.count=5000")
    return compare(name, root)


if __name__ == "__main__":
    sys.exit(main())
