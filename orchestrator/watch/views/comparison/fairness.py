"""Why a comparison of runs is not fair: one line for each reason."""

from collections.abc import Callable, Iterator, Sequence

from panolog.orchestrator.watch.views.comparison.reading import ReadRun
from panolog.orchestrator.watch.views.comparison.schema import ComparedRun, MeasuredView

Pair = tuple[ReadRun, ComparedRun]  # a run as it was read and as it is shown
_CONDITIONS: dict[str, Callable[[MeasuredView], str]] = {  # that are to be the same
    "at the same width": lambda head: "" if head.width is None else f"{head.width} pixels",
    "with the same crop at the bottom": lambda head: f"{head.crop_bottom or 0.0:g}",
    "with the same levels of detail": lambda head: f"of {head.detail:g} pixels" if head.detail else "none",
}


def warnings(runs: Sequence[Pair]) -> Iterator[str]:
    """The reasons, of runs that could be read; the first is what the others are compared with."""
    yield from _unfinished(runs)
    yield from (f"{run.name}: {run.problem}" for run, _ in runs if run.problem)
    yield from _differ("not of the same scene", [(it.name, (it.fingerprint or "")[:12]) for _, it in runs])
    measured = [pair for pair in runs if pair[0].measured is not None]
    missing = [shown.name for run, shown in runs if run.measured is None and not run.problem]
    if missing:
        yield f"not measured yet, without metrics: {', '.join(missing)}"
    yield from _outdated(measured)
    for what, text in _CONDITIONS.items():
        heads = [(shown.name, text(run.measured.head)) for run, shown in measured if run.measured]
        yield from _differ(f"not measured {what}", heads)
    yield from _held_out(measured)
    machines = [(shown.name, ", ".join(shown.machines)) for _, shown in runs]
    yield from _differ("not on the same machines, so their minutes say little", machines)


def _unfinished(runs: Sequence[Pair]) -> Iterator[str]:
    open_runs = [
        f"{shown.name} ({shown.label}, {int(100 * shown.progress)}%)"
        for _, shown in runs
        if shown.status != "done"
    ]
    if open_runs:
        yield f"not finished: {', '.join(open_runs)}"


def _differ(what: str, texts: Sequence[tuple[str, str]]) -> Iterator[str]:
    """A line with what each run has, if that is not the same; what a run does not state is left out.

    Args: texts, the name of each run and what it has.
    """
    if len({value for _, value in texts if value}) > 1:
        yield f"{what}: {', '.join(f'{name} {value}' for name, value in texts if value)}"


def _outdated(runs: Sequence[Pair]) -> Iterator[str]:
    """Metrics of a model that the run has replaced."""
    for run, shown in runs:
        merged = run.view.summary.model
        count = shown.measured.gaussians if shown.measured else None
        if merged is not None and count is not None and count != merged.gaussians:
            yield (
                f"{shown.name}: its metrics are of a model with {count:,} Gaussians, and the run's has"
                f" {merged.gaussians:,}; `panolog eval` measures it"
            )


def _held_out(runs: Sequence[Pair]) -> Iterator[str]:
    """Different held-out panoramas than those of the first run that has metrics."""
    if not runs:
        return
    (first, shown), *others = runs
    views = first.measured.views if first.measured else {}
    for run, other in others:
        theirs = run.measured.views if run.measured else {}
        if theirs.keys() != views.keys():
            common = len(theirs.keys() & views.keys())
            of = f"differences are of the {common:,} that both have" if common else "they have none in common"
            yield (
                f"not measured on the same panoramas: {shown.name} on {len(views):,}, {other.name} on"
                f" {len(theirs):,}; {of}"
            )
