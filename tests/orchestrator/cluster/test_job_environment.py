"""What a job on a cluster gets from the command that starts it, with a job server that only records."""

from types import SimpleNamespace
from typing import Any

import pytest

from panolog.orchestrator.cluster.jobs import Cluster
from panolog.orchestrator.run import log


class Recorder:
    """The client of a job server."""

    def __init__(self) -> None:
        self.submitted: dict[str, Any] = {}

    def list_jobs(self) -> list[Any]:
        return []

    def submit_job(self, **job: Any) -> str:
        self.submitted = job
        return "job"

    def get_job_info(self, name: str) -> Any:
        return SimpleNamespace(
            submission_id=name, status=SimpleNamespace(value="PENDING"), driver_exit_code=None, message=""
        )


@pytest.mark.parametrize("level", [None, "INFO", "DEBUG"])
def test_a_job_logs_as_the_command_that_starts_it(monkeypatch: pytest.MonkeyPatch, level: str | None) -> None:
    monkeypatch.delenv(log.VARIABLE, raising=False)
    if level:
        monkeypatch.setenv(log.VARIABLE, level)
    client = Recorder()
    Cluster("http://head:8265", client, guarded=True).begin("/runs/a", ["panolog", "run"])
    assert client.submitted["runtime_env"]["env_vars"].get(log.VARIABLE) == level
