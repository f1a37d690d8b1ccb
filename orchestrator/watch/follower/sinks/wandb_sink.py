"""Weights & Biases, through its client. Its credentials come from WANDB_API_KEY or from netrc.

A run there has one count of steps that only grows, so each curve has the iterations of its task as its x
axis. The client can read nothing back: after a kill between logging and noting, the last points may be there
twice, with equal iterations.
"""

import os
from collections.abc import Mapping, Sequence
from itertools import groupby
from pathlib import Path

import wandb
from typing_extensions import override
from wandb.errors import Error

from panolog.orchestrator.runs.records import Outcome
from panolog.orchestrator.watch.follower.sinks.interface import Facts, Point, Sink

_CODES = {Outcome.DONE: 0, Outcome.LIMITED: 0, Outcome.FAILED: 1, Outcome.INTERRUPTED: 130, None: 137}


class WandbSink(Sink):
    """Args: project; folder, where the client keeps what it has not sent yet."""

    errors = (Error, OSError)

    def __init__(self, project: str, folder: Path) -> None:
        self._project, self._folder = project, folder
        self._run: wandb.Run | None = None
        self._known: set[str] = set()  # tasks whose axis is declared

    @override
    def open(self, facts: Facts, known: str) -> str:
        self._folder.mkdir(parents=True, exist_ok=True)
        quiet = wandb.Settings(silent=True, console="off", disable_git=True, x_disable_meta=True)
        self._run = wandb.init(
            project=os.environ.get("WANDB_PROJECT") or self._project,
            id=facts.id,
            name=facts.name,
            resume="allow",
            config=dict(facts.settings),
            dir=str(self._folder),
            settings=quiet,
        )
        return facts.id

    @property
    def _live(self) -> "wandb.Run":
        assert self._run is not None  # `open` comes first
        return self._run

    @override
    def present(self, task: str, after: int, until: int, names: Sequence[str]) -> set[tuple[str, int]]:
        """Nothing: the client can read nothing back."""
        return set()

    @override
    def log(self, task: str, points: Sequence[Point]) -> None:
        """Adds points, which the client sends a little later."""
        axis = f"{task}/iteration"
        if task not in self._known:
            self._live.define_metric(axis, hidden=True)
            self._live.define_metric(f"{task}/*", step_metric=axis)
            self._known.add(task)
        for iteration, group in groupby(points, key=lambda point: point.iteration):
            self._live.log({axis: iteration} | {f"{task}/{point.name}": point.value for point in group})

    @override
    def finish(self, outcome: Outcome | None, metrics: Mapping[str, float], report: Path | None) -> None:
        self._live.summary.update({f"final/{name}": value for name, value in metrics.items()})
        if report is not None:
            artifact = wandb.Artifact(f"report-{self._live.id}", type="report")
            artifact.add_file(str(report))
            self._live.log_artifact(artifact)
        self._live.finish(exit_code=_CODES[outcome])
