"""Runs on a remote cluster: commands of the command line as jobs of Ray's job server on the head node.

All paths are the head's, and nothing about a run is kept here or there: its jobs are listed by the server,
its state is in the run folder, read by `panolog status` on the head.
"""

import json
import os
import re
import shlex
import time
import urllib.request
from base64 import b64decode
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import PurePosixPath
from typing import Any
from urllib.parse import urlsplit

from panolog.orchestrator.runs import log
from panolog.orchestrator.runs.folder import command_line
from panolog.scene.errors import ClusterError, RunError
from panolog.scene.stores.url import is_url, parse_url

RUN_KEY = "panolog_run"  # in a job's metadata: the run folder that it writes
_TIMEOUT_S = 10.0  # for a job server to identify itself
_POLL = 0.3  # seconds between two queries of a job
_STOP = 600  # seconds that a driver gets for its checkpoints before Ray kills it; Ray's own default is 3
# Ray writes its own lines into a job's log at any time, so the output of a command becomes one marked line.
_CALL = 'output=$({} 2>&1); code=$?; echo "panolog-output $(printf %s "$output" | base64 -w0)"; exit $code'
_OUTPUT = re.compile(r"^panolog-output ([A-Za-z0-9+/=]*)$", re.MULTILINE)
_STATUS = {
    "PENDING": "waiting",
    "RUNNING": "running",
    "SUCCEEDED": "done",
    "FAILED": "failed",
    "STOPPED": "interrupted",
}


@dataclass(frozen=True)
class ClusterJob:
    """A job that writes a run folder."""

    id: str
    status: str  # "waiting", "running", "done", "failed" or "interrupted"
    exit_code: int | None = None
    reason: str | None = None  # one line, of a job that failed

    @property
    def label(self) -> str:
        """The status by the name that people read, as that of a run."""
        return "stopped" if self.status == "interrupted" else self.status

    @property
    def over(self) -> bool:
        """Whether nothing more can come of it."""
        return self.status not in ("waiting", "running")


class Cluster:
    """A job server. Made by `connect`. Every method raises RunError if the server fails."""

    def __init__(self, address: str, client: Any, *, guarded: bool) -> None:
        self.address = address
        self.guarded = guarded  # whether it lets in only those who have its token
        self._client = client  # ray.job_submission.JobSubmissionClient

    def begin(self, run: str, command: Sequence[str]) -> ClusterJob:
        """Starts a command that drives the run at `run`, and does not wait for it.

        Raises InputError if a job is at work on that run.
        """
        if (job := self.job_of(run)) and not job.over:
            raise ClusterError(
                f"{run}: job {job.id} is driving it; see `{command_line('cluster', 'status', run)}`,"
                f" or end it with `{command_line('cluster', 'stop', run)}`"
            )
        environment = {"env_vars": {"RAY_JOB_STOP_WAIT_TIME_S": str(_STOP), **log.environment()}}
        with _served(self.address):
            name = self._client.submit_job(
                entrypoint=f"exec {shlex.join(command)}",  # no shell between the driver and its signals
                runtime_env=environment,
                metadata={RUN_KEY: run, "job_name": f"panolog {PurePosixPath(run).name}"},
            )
            return _job(self._client.get_job_info(name))

    def job_of(self, run: str) -> ClusterJob | None:
        """The job that began last among those of a run; None if this cluster has had none."""
        with _served(self.address):
            jobs = [job for job in self._client.list_jobs() if (job.metadata or {}).get(RUN_KEY) == run]
        return _job(max(jobs, key=lambda job: job.start_time or 0)) if jobs else None

    def stop(self, run: str) -> ClusterJob:
        """Interrupts the job of a run as Ctrl-C would, and waits until it has ended.

        Raises InputError if none is at work.
        """
        job = self.job_of(run)
        if job is None or job.over:
            raise ClusterError(f"{run}: no job on the cluster at {self.address} is driving it")
        with _served(self.address):
            self._client.stop_job(job.id)
        return self._end_of(job.id)

    def call(self, command: Sequence[str]) -> tuple[int, str]:
        """Runs a short command on the head. Returns its exit code and what it printed."""
        with _served(self.address):
            name = self._client.submit_job(entrypoint=_CALL.format(shlex.join(command)))
        job = self._end_of(name)
        with _served(self.address):
            output = _OUTPUT.search(self._client.get_job_logs(name))
            self._client.delete_job(name)  # the dashboard's list of jobs is for runs
        if job.exit_code is None or output is None:
            raise RunError(f"the cluster at {self.address} could not run panolog: {job.reason}")
        return job.exit_code, b64decode(output[1]).decode()

    def _end_of(self, name: str) -> ClusterJob:
        while True:
            with _served(self.address):
                job = _job(self._client.get_job_info(name))
            if job.over:
                return job
            time.sleep(_POLL)


def connect(address: str) -> Cluster:
    """The job server at an address such as http://HOST:8265.

    Where it requires a token, Ray takes it from RAY_AUTH_TOKEN, from the file RAY_AUTH_TOKEN_PATH or from
    ~/.ray/auth_token. Raises InputError if no server answers or it refuses the token.
    """
    address = address.rstrip("/")
    if urlsplit(address).scheme not in ("http", "https"):
        raise ClusterError(f"--address {address}: write http://HOST:8265, that of the dashboard")
    guarded = _asks_for_token(address)
    if guarded:
        os.environ.setdefault("RAY_AUTH_MODE", "token")  # read by Ray when it is imported
    os.environ["RAY_API_SERVER_ADDRESS"] = address  # or Ray would prefer RAY_ADDRESS
    from ray.job_submission import JobSubmissionClient  # noqa: PLC0415

    with _served(address):
        return Cluster(address, JobSubmissionClient(address), guarded=guarded)


def _asks_for_token(address: str) -> bool:
    """Raises InputError if no job server answers. The one question that Ray answers to everybody."""
    try:
        with urllib.request.urlopen(f"{address}/api/authentication_mode", timeout=_TIMEOUT_S) as reply:
            mode: str = json.load(reply)["authentication_mode"]
    except (OSError, ValueError, KeyError) as error:
        raise ClusterError(
            f"--address {address}: no job server of Ray 2.52 or newer answers there ({error})"
        ) from error
    return mode != "disabled"


def on_head(path: str, what: str) -> str:
    """A path of the head node, which may not depend on where a command is typed, or a URL of a store.

    Raises InputError.
    """
    if is_url(path):
        return str(parse_url(path))
    if not PurePosixPath(path).is_absolute():
        raise ClusterError(f"{what} {path}: is on the cluster's head node; write it from / on")
    return str(PurePosixPath(path))


def _job(details: Any) -> ClusterJob:
    status = _STATUS[details.status.value]
    lines = (details.message or "").strip().splitlines() if status == "failed" else []
    reason = lines[-1].removeprefix("panolog: ") if lines else None
    return ClusterJob(details.submission_id, status, details.driver_exit_code, reason)


@contextmanager
def _served(address: str) -> Iterator[None]:
    """Turns what Ray's client raises into errors of ours."""
    from ray.exceptions import AuthenticationError  # noqa: PLC0415

    try:
        yield
    except AuthenticationError as error:
        reason = error.message.splitlines()[0].partition(". ")[0]
        raise ClusterError(
            f"--address {address}: {reason}; put the cluster's token into ~/.ray/auth_token"
            " or into a file that RAY_AUTH_TOKEN_PATH names"
        ) from error
    except (OSError, RuntimeError) as error:  # no answer; an answer that is an error
        raise RunError(f"the job server at {address} failed: {error}") from error
