"""MLflow, through its client: a server, or a store that the client can open.

Credentials come from MLflow's own variables, such as MLFLOW_TRACKING_TOKEN.
"""

import os
from collections.abc import Mapping, Sequence
from pathlib import Path

from mlflow.entities import Metric, Param
from mlflow.exceptions import MlflowException
from mlflow.tracking import MlflowClient
from typing_extensions import override

from panolog.orchestrator.runs.records import Outcome
from panolog.orchestrator.watch.follower.sinks.interface import Facts, Point, Sink

_TAG = "panolog.run"
_BATCH, _PARAMS = 1000, 100  # of one request, as the REST API of MLflow limits them
_LONGEST = 500  # characters of a parameter that every store takes
_STATUS = {
    Outcome.DONE: "FINISHED",
    Outcome.LIMITED: "FINISHED",
    Outcome.FAILED: "FAILED",
    Outcome.INTERRUPTED: "KILLED",
    None: "FAILED",
}


class MlflowSink(Sink):
    """Args: uri, of the tracking server."""

    errors = (MlflowException, OSError)

    def __init__(self, uri: str) -> None:
        os.environ.setdefault("MLFLOW_HTTP_REQUEST_MAX_RETRIES", "1")  # the follower tries again itself
        os.environ.setdefault("MLFLOW_HTTP_REQUEST_TIMEOUT", "20")
        self._client = MlflowClient(tracking_uri=uri)
        self._run = ""

    @override
    def open(self, facts: Facts, known: str) -> str:
        """Takes up the run; one that was made before a kill is found by its tag."""
        self._run = known or self._find(facts)
        self._client.update_run(self._run, status="RUNNING")
        if not known:
            settings = [Param(name, str(value)[:_LONGEST]) for name, value in facts.settings.items()]
            for first in range(0, len(settings), _PARAMS):
                self._client.log_batch(self._run, params=settings[first : first + _PARAMS])
        return self._run

    def _find(self, facts: Facts) -> str:
        name = os.environ.get("MLFLOW_EXPERIMENT_NAME", "panolog")
        experiment = self._client.get_experiment_by_name(name)
        id = experiment.experiment_id if experiment else self._client.create_experiment(name)
        if found := self._client.search_runs([id], f"tags.`{_TAG}` = '{facts.id}'", max_results=1):
            return str(found[0].info.run_id)
        run = self._client.create_run(id, run_name=facts.name, tags={_TAG: facts.id})
        return str(run.info.run_id)

    @override
    def present(self, task: str, after: int, until: int, names: Sequence[str]) -> set[tuple[str, int]]:
        return {
            (name, metric.step)
            for name in names
            for metric in self._client.get_metric_history(self._run, f"{task}/{name}")
            if after < metric.step <= until
        }

    @override
    def log(self, task: str, points: Sequence[Point]) -> None:
        metrics = [
            Metric(f"{task}/{it.name}", it.value, round(1000 * it.time), it.iteration) for it in points
        ]
        for first in range(0, len(metrics), _BATCH):
            self._client.log_batch(self._run, metrics=metrics[first : first + _BATCH])

    @override
    def finish(self, outcome: Outcome | None, metrics: Mapping[str, float], report: Path | None) -> None:
        for name, value in metrics.items():
            self._client.log_metric(self._run, f"final/{name}", value, step=0)
        if report is not None:
            self._client.log_artifact(self._run, str(report))
        self._client.set_tag(self._run, "panolog.outcome", str(outcome or "killed"))
        self._client.set_terminated(self._run, _STATUS[outcome])
