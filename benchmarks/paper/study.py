"""All that a command has measured, as it is kept in FOLDER/results.json and read by the pages."""

import json
import shlex
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
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
    """Results with how they were measured."""

    settings: Settings
    chosen: tuple[str, ...]  # tables
    scenes: tuple[str, ...]  # the last two folders of each path: one may name a published data set
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
    def name(self) -> str:
        """The name of the study's folder next to a page: what all runs have in common, and the tables."""
        given = self.settings
        parts = (given.width, given.iterations, given.blocks, *given.sets, *self.chosen)
        return "-".join(map(str, parts))

    @property
    def command(self) -> str:
        """The command that measures the whole study, without the folders of a machine."""
        given = self.settings
        seeds = 1 + max((result.seed for result in self.results.all), default=0)
        words = ["python", "-m", "benchmarks.paper", *(Path(scene).name for scene in self.scenes)]
        words += ["-o", "FOLDER", "--tables", ",".join(self.chosen)]
        words += ["--width", str(given.width), "--iterations", str(given.iterations)]
        words += ["--blocks", given.blocks, "--seeds", str(seeds)]
        words += [part for setting in given.sets for part in ("--set", setting)]
        words += [part for scene, kind in self.kinds.items() for part in ("--kind", f"{scene}={kind}")]
        return shlex.join(words)

    @property
    def title(self) -> str:
        """Of a section: what all runs have in common."""
        width, iterations = self.settings.width, self.settings.iterations
        return f"{width}×{width // 2}, {iterations:,} iterations, blocks {self.settings.blocks}"

    @property
    def place(self) -> str:
        """On what and with what it was measured."""
        codes, machines = list(self.results.codes.values()), self.results.machines
        parts = [f"Rows of {len(machines)} machines" if len(machines) > 1 else f"On {''.join(machines)}"]
        parts += [f"of {len(codes)} versions of the code" if len(codes) > 1 else f"code {''.join(codes)}"]
        return ", ".join(parts) + (": each says which." if max(len(codes), len(machines)) > 1 else ".")

    def joined(self, later: "Study") -> "Study":
        """This study, with what a later one of the same name has measured anew or in addition."""
        both = sorted((*self.results.all, *later.results.all), key=lambda it: not it.failed)
        results = {(it.scene, it.variant, it.seed): it for it in both}
        overlaps = {(it.scene, it.variant, it.tau): it for it in (*self.overlaps, *later.overlaps)}
        names = {Path(scene).name: scene for scene in (*self.scenes, *later.scenes)}
        return replace(
            later,
            scenes=tuple(names.values()),
            results=Results(tuple(results.values())),
            overlaps=tuple(overlaps.values()),
            kinds={**self.kinds, **later.kinds},
        )

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
            Settings(**{**settings, "sets": tuple(settings["sets"])}),
            tuple(stored["chosen"]),
            tuple(stored["scenes"]),
            Results([from_json(result) for result in stored["results"]]),
            tuple(Overlap(**overlap) for overlap in stored["overlaps"]),
            stored.get("kinds", {}),
        )
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError(f"{path}: holds no results of benchmarks.paper: {error}") from error
