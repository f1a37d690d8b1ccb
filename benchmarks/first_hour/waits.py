"""Where a training waits for the card, and the time of an iteration whose kernels have little to do."""

import warnings
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from statistics import median

import torch

import panolog
from benchmarks.first_hour.outcome import ROOT, Context, Outcome
from benchmarks.report import markdown
from panolog.orchestrator.runs.config import load_config
from panolog.synthetic.make import make_town
from panolog.workers.tasks import Progress

_ITERATIONS = 4_000  # some seconds; those of densification are among them
_REHEARSED = 400
_SYNCHRONIZING = "synchronizing CUDA operation"  # in the warning of torch.cuda.set_sync_debug_mode


def count(context: Context) -> Outcome:
    """Trains a town of a few thousand Gaussians in this process, at 64 × 32 pixels."""
    iterations = _ITERATIONS if context.cuda else _REHEARSED
    town = make_town(context.work / "town", panoramas=9, width=64, points=2_000)
    flags = {"device": context.device, "iterations": iterations, "sky.count": 500}
    found: Counter[str] = Counter()
    with counted(found) if context.cuda else warnings.catch_warnings():
        events = list(panolog.train(town, load_config(flags=flags)))
    rates = [event.rate for event in events if isinstance(event, Progress) and event.rate]
    if not rates:
        return Outcome("failed", reason=f"{iterations} iterations gave no rate")
    milliseconds = 1e3 / median(rates)
    each = found.total() / iterations
    rows = [(place, number, iterations / number) for place, number in found.most_common()]
    content = {"iterations": iterations, "milliseconds": milliseconds, "waits": dict(found)}
    text = markdown(("where", "waits", "iterations for each"), rows) if rows else ""
    figure = f"{milliseconds:.2f} ms an iteration"
    if not context.cuda:
        return Outcome("passed", f"{figure}; waits are counted on a card", "", (), content)
    return Outcome("passed", f"{each:.3f} waits and {figure}", "", (), content, text)


@contextmanager
def counted(found: Counter[str]) -> Iterator[None]:
    """Counts the waits within it by file and line: torch warns of each."""
    torch.cuda.set_sync_debug_mode("warn")
    try:
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            yield
    finally:
        torch.cuda.set_sync_debug_mode("default")
    for warning in caught:
        if _SYNCHRONIZING in str(warning.message):
            found[f"{_relative(warning.filename)}:{warning.lineno}"] += 1


def _relative(file: str) -> str:
    path = Path(file).resolve()
    return str(path.relative_to(ROOT)) if path.is_relative_to(ROOT) else path.name
