"""Memory and time that preflight estimates for a run, against what the run then takes, stage by stage.

    python -m benchmarks.preflight [--data FOLDER] [--iterations 300] [--width 256] [--folder FOLDER] [--json]

Three scenes: a street and a flat from the folder with test data (by default ../shared/data next to the
checkout), if they exist, and the demo's town. Each run calibrates itself just before it begins,
so that estimate and run see the same load of the machine. The goal is 15% of memory and 25% of time.
"""

import json
import os
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from benchmarks import report
from benchmarks.runs import history, panolog, stage_seconds
from panolog.orchestrator.runs.folder import RunFolder
from panolog.orchestrator.runs.records import Progressed
from panolog.synthetic.make import make_town

DATA = Path(__file__).resolve().parents[2] / "shared" / "data"
SHARED = ("street", "flat")
HEAD = ("scene", "stage", "Gaussians", "", "MiB", "", "error", "seconds", "", "error")
WHOLE = "all"
MEMORY, TIME = 0.15, 0.25  # the goals, as fractions


@dataclass(frozen=True)
class Comparison:
    """One stage of a scene, or the whole run; estimated, then measured."""

    scene: str
    stage: str
    gaussians: tuple[int | None, int | None]
    memory: tuple[int, int]  # bytes: the peak of a worker's process, or of a task on its GPU
    seconds: tuple[float, float]

    @property
    def memory_error(self) -> float:
        """Error of the estimate, as a fraction of the measurement."""
        return self.memory[0] / self.memory[1] - 1

    @property
    def time_error(self) -> float:
        """Error of the estimate of the time, as a fraction of the measurement."""
        return self.seconds[0] / self.seconds[1] - 1

    def cells(self) -> tuple[object, ...]:
        """The comparison in the order of HEAD."""
        memory = (*(round(value / 2**20) for value in self.memory), f"{self.memory_error:+.0%}")
        return (self.scene, self.stage, *self.gaussians, *memory, *self.seconds, f"{self.time_error:+.0%}")


def compare(name: str, root: Path) -> list[Comparison]:
    """The stages of a finished run that have tasks, and the whole run."""
    expected = json.loads(RunFolder(root).preflight.read_bytes())["estimate"]
    records = history(root)
    seconds = stage_seconds(records)
    seconds["score"] = seconds.get("score", 0.0) + seconds.get("plan", 0.0)
    progress = [stored.record for stored in records if isinstance(stored.record, Progressed)]
    rows = [
        Comparison(
            name,
            stage["name"],
            (stage["gaussians"], max(p.gaussians or 0 for p in of_stage)),
            _peaks(stage, of_stage),
            (stage["seconds"], seconds[stage["name"]]),
        )
        for stage in expected["stages"]
        if (of_stage := [p for p in progress if p.task.stage == stage["name"]])
    ]
    memory = (max(row.memory[0] for row in rows), max(row.memory[1] for row in rows))
    total = sum(value for key, value in seconds.items() if key != "plan")
    return [*rows, Comparison(name, WHOLE, (None, None), memory, (expected["seconds"], total))]


def _peaks(stage: dict[str, Any], progress: Sequence[Progressed]) -> tuple[int, int]:
    """Bytes, estimated and measured: of the GPU where there is one."""
    if stage["device"]:
        return stage["device"], max(p.memory or 0 for p in progress)
    return stage["host"], max(p.host_peak or 0 for p in progress)


def scenes(data: Path, folder: Path) -> dict[str, Path]:
    """The scenes that exist, by name; the town is made in `folder`."""
    found = {name: data / name for name in SHARED if (data / name).is_dir()}
    return found | {"town": make_town(folder / "town")}


def summary(rows: Sequence[Comparison]) -> str:
    """How many scenes meet the goals."""
    whole = [row for row in rows if row.stage == WHOLE]
    memory = sum(abs(row.memory_error) <= MEMORY for row in whole)
    time = sum(abs(row.time_error) <= TIME for row in whole)
    return f"of {len(whole)} scenes, memory within {MEMORY:.0%} in {memory}, time within {TIME:.0%} in {time}"


def measure(data: Path, folder: Path, settings: Sequence[str]) -> list[Comparison]:
    """Runs the scenes in `folder`, with these options of `panolog run`. Raises RunError if one fails."""
    folder.mkdir(parents=True)
    rows = []
    for name, scene in scenes(data, folder).items():
        root = folder / f"run-{name}"
        panolog("run", str(scene), "-o", str(root), *settings, "--set", "sky.count=5000")
        rows += compare(name, root)
    return rows


def main(arguments: Sequence[str] | None = None) -> int:
    """The program; returns its exit code."""
    parser = report.parser("preflight", __doc__, quick=False)
    parser.add_argument("--data", type=Path, default=DATA, help="folder of the scenes street and flat")
    parser.add_argument("--iterations", type=int, default=300, help="of Stage I and of each block")
    parser.add_argument("--width", type=int, default=256, help="pixels")
    parser.add_argument("--folder", type=Path, help="keep the runs here, a folder that does not exist yet")
    options = parser.parse_args(arguments)

    def work() -> report.Report:
        settings = ["--iterations", str(options.iterations), "--width", str(options.width)]
        with tempfile.TemporaryDirectory() as temporary:
            rows = measure(options.data, options.folder or Path(temporary) / "runs", settings)
        parts = [
            f"{options.width} pixels, {options.iterations} iterations",
            f"load of this machine in the last 15 minutes: {os.getloadavg()[2]:.1f}",
            "each pair: estimated, measured",
            report.markdown(HEAD, [row.cells() for row in rows]),
            summary(rows),
        ]
        return report.Report({"rows": [asdict(row) for row in rows]}, "\n\n".join(parts))

    return report.run("preflight", options, work)


if __name__ == "__main__":
    sys.exit(main())
