"""The tables of the report, as functions of results."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from scipy.sparse import csr_array

from benchmarks import report
from benchmarks.paper import reference
from benchmarks.paper.results import METRICS, Result, Results, spread
from benchmarks.paper.variants import Group, groups, variants
from panolog.partition.assignment import Assignment, assign
from panolog.partition.plan import Plan

TAUS = (1.0, 0.9, 0.8, 0.7, 0.5, 0.3, 0.1, 0.02)
_FIELDS = (
    *("scene", "variant", "seed", "iterations", "densified", "resets", "blocks", *METRICS, "gaussians"),
    *("bytes", "total", "on_workers", "longest", "threads", "memory", "overlap", "added", "same_as"),
    *("notes", "code", "failed"),
)


@dataclass(frozen=True)
class Table:
    """A table with what it is of."""

    title: str
    head: tuple[str, ...]
    rows: tuple[tuple[object, ...], ...]
    notes: tuple[str, ...] = ()

    def markdown(self) -> str:
        """With its title as a heading."""
        return "\n\n".join([f"### {self.title}", report.markdown(self.head, self.rows), *self.notes])


@dataclass(frozen=True)
class Overlap:
    """What a plan assigns at one τ."""

    scene: str
    variant: str
    tau: float
    blocks: float  # per camera, on average
    added: float  # share of all assignments that gradients add


def main_tables(results: Results, chosen: Sequence[str], scenes: Sequence[Path]) -> list[Table]:
    """All tables of variants, scene by scene, with the paper's rows where it has the scene.

    Then the means over the scenes of a data set, where the paper has these.
    """
    made = []
    for group in groups():
        if group.name not in chosen:
            continue
        table = f"table/{group.source}" if group.source else ""
        known = [reference.name_of(scene) if group.name == "main" else table for scene in scenes]
        for scene, name in zip(scenes, known, strict=True):
            note, shown = group.note if scene is scenes[0] else "", name not in reference.DATA_SETS
            made.append(_of_group(results, group, scene.name, name if shown else "", note))
        for name in sorted(reference.DATA_SETS.intersection(known)):
            own = [scene.name for scene, of in zip(scenes, known, strict=True) if of == name]
            made.append(_of_group(results.mean(name, own), group, name, name))
    return made


def _of_group(results: Results, group: Group, scene: str, known: str, note: str = "") -> Table:
    """Args: known, the name of the paper's rows in `reference.PUBLISHED`, if it has any."""
    base = group.variants[0]
    rows = [row for name in group.variants if (row := _row(results, scene, name, base))]
    notes = [note] if note else []
    if known:
        none, published = (None,) * 4, reference.PUBLISHED[known]
        rows += [
            (f"{row.method} [1]", None, row.psnr, row.ssim, None, row.lpips, *none, row.size, *(None,) * 7)
            for row in published
        ]
        notes.append(
            f"[1] {published[0].source}: printed numbers, at 30,000 iterations on its own machine;"
            " it does not say which LPIPS."
        )
    return _without_empty(Table(f"{group.title}: {scene}", HEAD, tuple(rows), tuple(notes)))


def _without_empty(table: Table) -> Table:
    """A table without the columns of metrics that no row has, such as LPIPS where its weights are missing."""
    names = enumerate(table.head)
    kept = [i for i, name in names if name not in _METRICS or any(row[i] is not None for row in table.rows)]
    rows = (tuple(row[i] for i in kept) for row in table.rows)
    return Table(table.title, tuple(table.head[i] for i in kept), tuple(rows), table.notes)


_METRICS = ("PSNR", "SSIM", "LPIPS", "LPIPS of 3DGS", "WS-PSNR", "WS-SSIM", "WS-PSNR 2×")  # as METRICS
HEAD = (
    *("variant", "gain dB", *_METRICS, "Gaussians", "MiB"),
    *("minutes", "on workers", "peak GB", "iterations", "densified", "resets", "notes"),
)


def _row(results: Results, scene: str, name: str, base: str) -> tuple[object, ...] | None:
    """A variant's row; None if it was not run."""
    found = results.of(scene, name)
    if not found:
        why = results.failure(scene, name)
        return (name, *(None,) * 16, f"failed: {why}") if why else None
    first = found[0]
    steps = f"{first.iterations:,}" + (f" + {first.blocks} × {first.iterations:,}" if first.blocks else "")
    other = results.first(scene, base)
    equal = other is not None and other.model == first.model
    same = _same(first, equal)
    gain = None if equal else results.gain(scene, name, base)
    return (
        name,
        gain and gain.signed,
        *(spread(result.metric(metric) for result in found) for metric in METRICS),
        round(sum(r.gaussians for r in found) / len(found)),
        first.bytes / reference.BYTES,
        spread(r.total / 60 for r in found),
        spread(r.on_workers / 60 for r in found),
        first.memory and first.memory / 1e9,
        steps,
        _times(first.densified, first.blocks),
        _times(first.resets, first.blocks),
        "; ".join([variants()[name].what, *([same] if same else []), *first.notes, *_origin(first, results)]),
    )


def _times(counts: Sequence[int], blocks: int) -> str | None:
    """How often, in Stage I and in the blocks; None where that was not recorded."""
    return " + ".join([str(n) if k == 0 else f"{blocks} × {n}" for k, n in enumerate(counts)]) or None


def _origin(result: Result, results: Results) -> list[str]:
    """By which code and on which machine a row was measured, where results are of several."""
    code = [f"measured at {result.code or 'unknown code'}"] if len(results.codes) > 1 else []
    return code + ([f"on {result.machine}"] if len(results.machines) > 1 else [])


def _same(result: Result, equal: bool) -> str:
    """What a row says that has not run itself. Args: equal, to the first row."""
    if not result.same_as:
        return ""
    none = " (no difference to report)" if equal else ""
    return f"same training or same plan as {result.same_as}, so the same model{none}"


def overlaps(scene: str, variant: str, plan: Plan, scores: csr_array) -> list[Overlap]:
    """What the scores (K, B) of a plan assign at other τ."""
    assigned = ((tau, assign(plan.camera_blocks, scores, tau)) for tau in TAUS)
    return [Overlap(scene, variant, tau, *overlap_of(found)) for tau, found in assigned]


def overlap_of(assignment: Assignment) -> tuple[float, float]:
    """Blocks that a camera trains on average, and the share of all assignments that gradients add."""
    return assignment.overlap, assignment.added / max(assignment.assigned.nnz, 1)


def overlap_table(found: Sequence[Overlap]) -> Table:
    """Blocks that a camera trains, by τ."""
    runs = list(dict.fromkeys((row.scene, row.variant) for row in found))
    by_run = {run: {row.tau: row for row in found if (row.scene, row.variant) == run} for run in runs}
    rows = [
        (f"{scene}, {variant}", *(_share(by_run[scene, variant][tau]) for tau in TAUS))
        for scene, variant in runs
    ]
    note = "Blocks per camera, and the share of assignments that gradients add; from the scores of each run."
    return Table("Overlap against τ", ("plan", *(f"τ {tau:g}" for tau in TAUS)), tuple(rows), (note,))


def _share(row: Overlap) -> str:
    return f"{row.blocks:.2f} ({100 * row.added:.0f} %)"


def csv_rows(results: Iterable[Result]) -> list[list[object]]:
    """One row for each run, the head first."""
    get: Callable[[Result, str], object] = lambda r, name: (  # noqa: E731
        r.metric(name) if name in METRICS else getattr(r, name)
    )
    rows: list[list[object]] = [list(_FIELDS)]
    for result in results:
        cells = [get(result, name) for name in _FIELDS]
        rows.append(["; ".join(map(str, cell)) if isinstance(cell, tuple) else cell for cell in cells])
    return rows
