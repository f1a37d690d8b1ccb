"""docs/scale.md: how bytes and seconds grow with a place, measured where it can be, and by law beyond.

    python -m benchmarks.scale -o FOLDER --docs docs/scale.md [--only laws,driver] [--scene CITY]

FOLDER keeps what each part has found; without --only, parts that it has are not measured again. The cities
take an hour on one core, all others half an hour, 20 GB of disk and 7 GB of memory.
"""

import json
import os
import sys
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from benchmarks import report
from benchmarks.paper.curves import standalone
from benchmarks.scale import cities, driver, laws, merging, models, plans
from benchmarks.scale.page import page
from panolog.orchestrator.runs.folder import write_json
from panolog.scene.errors import ConfigError
from panolog.scene.files import write_bytes
from panolog.synthetic.make import make_city

_CALIBRATION = 24  # panoramas of the city that is calibrated on
Found = dict[str, Any]


class Parts:
    """What is measured, each by the name of its part; small if that is all that is wanted."""

    def __init__(self, disk: Path, scene: Path | None, scenes: Path, *, quick: bool) -> None:
        """Args: disk, an empty folder to measure in; scene to calibrate on; scenes, folder of cities."""
        self._disk, self._scene, self._scenes, self._quick = disk, scene, scenes, quick

    def cities(self) -> Found:
        """The largest tasks of cities whose blocks keep their size."""
        size = cities.Size(64, 6, 12, 6) if self._quick else cities.Size(512, 150)
        sizes = [12, 24] if self._quick else [75, 300, 1200]
        found = cities.cities(self._disk, self._scenes, sizes, size)
        return {"cities": {"size": asdict(size), "cities": [asdict(city) for city in found]}}

    def laws(self) -> Found:
        """The tasks of cities, and the calibrations behind them."""
        known, widths = ([64], [64, 128]) if self._quick else ([512, 1024], [512, 1024, 2048, 3840])
        sizes = [75, 300] if self._quick else [75, 300, 1200, 4800, 19_200]
        scene = self._scene or make_city(
            self._disk / "city", panoramas=4 if self._quick else _CALIBRATION, width=known[-1]
        )
        bases = laws.calibrated(scene, known, repeats=1 if self._quick else 3)
        rows = list(laws.laws(bases, sizes, widths))
        return {
            "laws": [asdict(row) for row in rows],
            "calibrations": [asdict(row) for row in laws.shown(bases)],
        }

    def driver(self) -> Found:
        """The driver."""
        load = driver.Load(12, 4, 10.0, 0.5) if self._quick else driver.Load(10_000, 2_000, 0.2, 60.0)
        return {"driver": asdict(driver.measure(self._disk, load))}

    def plans(self) -> Found:
        """The plan, and the scores behind it."""
        sizes = [(60, 12, 4)] if self._quick else [(6_000, 1_000, 50), (100_000, 1_333, 50)]
        return {"plans": [asdict(plans.measure(self._disk, *size)) for size in sizes]}

    def merge(self) -> Found:
        """The merge."""
        sizes, each = ([1000, 2000], 500) if self._quick else ([2_500_000, 10_000_000, 40_000_000], 200_000)
        return {"merge": [asdict(row) for row in merging.merges(self._disk, sizes, each)]}

    def levels(self) -> Found:
        """The levels of detail."""
        sizes, each = ([150, 300], 20) if self._quick else ([75, 300, 1200, 2400], 500)
        return {"levels": [asdict(row) for row in models.hierarchies(self._disk, sizes, each)]}

    def all(self) -> dict[str, Callable[[], Found]]:
        """By name, in the order of the page."""
        return {
            "cities": self.cities,
            "laws": self.laws,
            "driver": self.driver,
            "plans": self.plans,
            "merge": self.merge,
            "levels": self.levels,
        }


def measure(
    folder: Path, only: Sequence[str], scene: Path | None, scenes: Path | None = None, *, quick: bool
) -> Found:
    """Measures parts and keeps them in `folder`; returns all that it has.

    Args: scene, scenes as `Parts` has them; by default in `folder`.
    Raises ConfigError if there is no such part, and what the parts raise.
    """
    scenes = scenes or folder / "scenes"
    names = list(Parts(folder, scene, scenes, quick=quick).all())
    if unknown := sorted(set(only) - set(names)):
        raise ConfigError(f"--only {','.join(unknown)}: the parts are {', '.join(names)}")
    folder.mkdir(parents=True, exist_ok=True)
    found: Found = {}
    for name in names:
        file = folder / f"{name}.json"
        if name in only or not (only or file.exists()):
            with TemporaryDirectory(prefix=f"{name}-", dir=folder) as disk:
                write_json(file, Parts(Path(disk), scene, scenes, quick=quick).all()[name]())
        if file.exists():
            found |= json.loads(file.read_bytes())
    return found


def write(found: Found, measured_on: str, path: Path) -> None:
    """Writes the page, and its pictures into a folder of its name."""
    folder = path.with_suffix("")
    pictures: dict[str, str] = {}
    if "cities" in found:
        pictures |= cities.pictures([cities.City.parse(row) for row in found["cities"]["cities"]])
    if "laws" in found:
        pictures |= laws.pictures([laws.Law(**row) for row in found["laws"]])
    for name, svg in pictures.items():
        folder.mkdir(parents=True, exist_ok=True)
        write_bytes(folder / f"{name}.svg", standalone(svg).encode())
    write_bytes(path, page(found, measured_on, folder.name).encode())


def main(arguments: Sequence[str] | None = None) -> int:
    """The program; returns its exit code."""
    parser = report.parser("scale", __doc__)
    parser.add_argument("-o", "--output", type=Path, required=True, help="folder of what is found")
    parser.add_argument("--docs", type=Path, help="the page to write; by default scale.md in the folder")
    parser.add_argument("--only", default="", help="parts to measure, separated by commas")
    parser.add_argument("--scene", type=Path, help="to calibrate on; by default a small city is made")
    parser.add_argument("--cities", type=Path, help="folder of scenes city-75, ...; missing ones are made")
    options = parser.parse_args(arguments)

    def work() -> report.Report:
        only = [name for name in options.only.split(",") if name]
        found = measure(options.output, only, options.scene, options.cities, quick=options.quick)
        path = options.docs or options.output / "scale.md"
        load = f"load of the machine in the last 15 minutes {os.getloadavg()[2]:.1f}"
        write(found, f"{report.sentence(report.machine())}, {load}", path)
        return report.Report(found, f"wrote {path}")

    return report.run("scale", options, work)


if __name__ == "__main__":
    sys.exit(main())
