"""`panolog cluster`: submit, resume, status, stop, leave. Runs on a Ray cluster, through its job server."""

import json
from collections.abc import Sequence
from dataclasses import asdict
from shutil import get_terminal_size
from typing import TYPE_CHECKING, Annotated, Any

import typer

from panolog.orchestrator.cli.console import command, print_json, progress_bar, say
from panolog.orchestrator.cli.options import (
    AcceptOption,
    AtEndOption,
    JsonOption,
    followed,
    grouped,
    preparation,
    run_config,
    wanted,
)
from panolog.orchestrator.cli.syntax import Command, Group, argument, option
from panolog.scene.errors import InputError

if TYPE_CHECKING:
    from panolog.orchestrator.runs.config import RunConfig
    from panolog.orchestrator.runs.money.limits import Wanted
    from panolog.orchestrator.runs.preparation.settings import Options

app = typer.Typer(
    cls=Group,
    no_args_is_help=True,
    help="Control runs on a Ray cluster, from any machine that reaches it: submit, resume, status, stop."
    " `leave` is for the machines of the cluster themselves.",
)

HeadRunArg = Annotated[str, argument("RUN", "Folder of the run on the head node.")]
ServerOption = Annotated[
    str,
    option(
        "http://HOST:8265",
        "URL of the cluster's Ray dashboard, which is its job server.",
        "--address",
        envvar="RAY_API_SERVER_ADDRESS",
    ),
]
_LOCAL = "http://127.0.0.1:8265"


@app.command(cls=Command)
@grouped(config=run_config, options=preparation, targets=followed, budget=wanted)
def submit(
    source: Annotated[
        list[str],
        argument("SCENE|SOURCE...", "The scene, or folders of panoramas and videos, on the head node."),
    ],
    output: Annotated[str, option("RUN", "Folder of the new run on the head node.", "--output", "-o")],
    *,
    config: "RunConfig",
    options: "Options",
    address: ServerOption = _LOCAL,
    targets: tuple[list[str], list[str]],
    budget: "Wanted",
    at_end: AtEndOption = None,
    as_json: JsonOption = False,
) -> None:
    """Start a run on the cluster, with the options of `panolog run`; F.yaml and prices are read here.

    What --notify names by @FILE or env:NAME is a file or a variable of the head node.
    """
    from panolog.orchestrator.engine.cluster.jobs import on_head
    from panolog.orchestrator.runs.config import as_settings
    from panolog.orchestrator.runs.preparation.settings import as_arguments

    sources, run = [on_head(it, "SCENE") for it in source], on_head(output, "--output")
    for what, path in {
        "--trajectory": options.sfm.get("trajectory"),
        "--mask-model": options.mask_model,
        "--depth-model": options.depth_model,
    }.items():
        if path is not None:
            on_head(path, what)
    words = ["run", *sources, "-o", run, *as_settings(config), *as_arguments(options), *budget.options()]
    _start(address, run, words, targets, at_end, as_json=as_json)


@app.command(cls=Command)
@grouped(targets=followed, budget=wanted)
def resume(
    run: HeadRunArg,
    *,
    address: ServerOption = _LOCAL,
    accept_changes: AcceptOption = False,
    targets: tuple[list[str], list[str]],
    budget: "Wanted",
    at_end: AtEndOption = None,
    as_json: JsonOption = False,
) -> None:
    """Resume a run on the cluster from its last checkpoints."""
    from panolog.orchestrator.engine.cluster.jobs import on_head

    run = on_head(run, "RUN")
    words = ["resume", run, *budget.options(), *["--accept-changes"] * accept_changes]
    _start(address, run, words, targets, at_end, as_json=as_json)


@app.command(cls=Command)
def status(run: HeadRunArg, address: ServerOption = _LOCAL, as_json: JsonOption = False) -> None:
    """Show the job of a run on the cluster, and its status."""
    from panolog.orchestrator.engine.cluster.jobs import connect, on_head

    run = on_head(run, "RUN")
    columns = f"COLUMNS={get_terminal_size().columns}"  # a table as wide as this terminal
    words = ["panolog", "status", run]
    with progress_bar(f"waiting for the cluster at {address}"):
        cluster = connect(address)
        job = cluster.job_of(run)
        code, output = cluster.call([*words, "--json"] if as_json else ["env", columns, *words])
    state: dict[str, Any] = {}
    if code == 0:
        state = json.loads(output) if as_json else state
    elif job is None:
        raise InputError(output.removeprefix("panolog: "))
    else:  # the job has not made its run folder yet, or failed to: only the job has a status
        output, state = "", {"run": run, "status": job.status, "reason": job.reason}
    if as_json:
        print_json(state | {"job": job and asdict(job)})
        return
    if job:
        print(f"job {job.id} · {job.label}" + (f" · {job.reason}" if job.reason else ""))
    if output:
        print(output)


@app.command(cls=Command)
def stop(run: HeadRunArg, address: ServerOption = _LOCAL, as_json: JsonOption = False) -> None:
    """Stop a run on the cluster; returns when its checkpoints are written."""
    from panolog.orchestrator.engine.cluster.jobs import connect, on_head

    run = on_head(run, "RUN")
    with progress_bar("waiting until the checkpoints are written"):
        job = connect(address).stop(run)
    if as_json:
        print_json({"run": run, "job": asdict(job)})
    else:
        resume_it = command("cluster", "resume", run, "--address", address)
        say(f"job {job.id}: {job.label}; {resume_it} resumes it")


@app.command(cls=Command)
def leave(
    seconds: Annotated[int, argument("SECONDS", "Seconds until the machine ends.", min=0, max=86_400)] = 120,
    node: Annotated[
        str, option("ID", "How the id of the node begins, if this machine has several of Ray's.", "--node")
    ] = "",
) -> None:
    """Announce that this machine leaves its cluster: tasks here save a checkpoint and move.

    Returns once they have, at the latest after so many seconds: for the preStop hook of a pod, and for the
    signal of a batch system. Machines of Amazon EC2, Google Compute Engine and Azure announce it themselves.
    """
    from panolog.orchestrator.engine.cluster.leave import leave as leave_cluster

    with progress_bar("waiting until the tasks of this machine have moved"):
        gone = leave_cluster(seconds, node)
    say("this machine has left the cluster" if gone else f"tasks of others still run here after {seconds} s")


def _start(
    address: str,
    run: str,
    words: Sequence[str],
    targets: tuple[list[str], list[str]],
    at_end: str | None,
    *,
    as_json: bool,
) -> None:
    from panolog.orchestrator.engine.cluster.jobs import connect
    from panolog.orchestrator.watch.follower.recipients import words_elsewhere

    words = [*words, *words_elsewhere(*targets), *(["--at-end", at_end] if at_end else [])]
    with progress_bar(f"waiting for the cluster at {address}"):
        cluster = connect(address)
        job = cluster.begin(run, ["panolog", *words, "--address", "auto", "--supervise"])
    if not cluster.guarded:
        say(f"{cluster.address} requires no token: any program that reaches it can run code on the cluster")
    if as_json:
        print_json({"run": run, "address": cluster.address, "job": asdict(job)})
    else:
        print(job.id)
        status = command("cluster", "status", run, "--address", cluster.address)
        say(f"started; {status} shows its status")
