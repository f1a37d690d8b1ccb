"""All that a command has measured, as it is kept in FOLDER/results.json and read by the pages."""

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from benchmarks.paper.goals import Goal, goals
from benchmarks.paper.results import Results, from_json
from benchmarks.paper.tables import Overlap, Table, main_tables, overlap_table
from benchmarks.paper.variants import Settings
from panolog.orchestrator.runs.folder import write_json
from panolog.scene.errors import InputError


@dataclass(frozen=True)
class Study:
    """Results with where and how they were measured."""

    command: str
    machine: str
    settings: Settings
    chosen: tuple[str, ...]  # tables
    scenes: tuple[str, ...]  # folders
    results: Results
    overlaps: tuple[Overlap, ...] = ()
    kinds: Mapping[str, str] = field(default_factory=dict)  # of `goals.KINDS` by scene

    @property
    def tables(self) -> list[Table]:
        """All tables of variants, and the overlap."""
        made = main_tables(self.results, self.chosen, [Path(scene) for scene in self.scenes])
        return [*made, *([overlap_table(self.overlaps)] if self.overlaps else [])]

    @property
    def goals(self) -> list[Goal]:
        """What it must show, as far as it was measured."""
        return goals(self.results, self.kinds)

    @property
    def title(self) -> str:
        """Of a section: what all runs have in common."""
        width, iterations = self.settings.width, self.settings.iterations
        return f"{width}×{width // 2}, {iterations:,} iterations, blocks {self.settings.blocks}"

    @property
    def place(self) -> str:
        """On what and with what it was measured."""
        codes = list(self.results.codes.values())
        several = f"Rows of {len(codes)} versions of the code: each says which."
        return f"On {self.machine}. " + (several if len(codes) > 1 else "".join(f"Code: {c}." for c in codes))

    def to_json(self) -> dict[str, Any]:
        """As plain values."""
        stored = asdict(self) | {"results": [asdict(result) for result in self.results.all]}
        return stored | {"goals": [asdict(goal) for goal in self.goals]}

    def save(self, folder: Path) -> None:
        """Writes results.json."""
        write_json(folder / "results.json", self.to_json())


def load(folder: Path) -> Study:
    """The study in a folder. Raises InputError if there is none."""
    path = folder / "results.json"
    try:
        stored = json.loads(path.read_bytes())
        settings = stored["settings"]
        return Study(
            stored["command"],
            stored["machine"],
            Settings(**{**settings, "sets": tuple(settings["sets"])}),
            tuple(stored["chosen"]),
            tuple(stored["scenes"]),
            Results([from_json(result) for result in stored["results"]]),
            tuple(Overlap(**overlap) for overlap in stored["overlaps"]),
            stored.get("kinds", {}),
        )
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError(f"{path}: holds no results of benchmarks.paper: {error}") from error
