"""`panolog cluster`: submit, resume, status, stop. Runs on a Ray cluster, through its job server."""

import json
from collections.abc import Sequence
from dataclasses import asdict
from shutil import get_terminal_size
from typing import TYPE_CHECKING, Annotated, Any

import typer

from panolog.orchestrator.cli.console import print_json, say
from panolog.orchestrator.cli.options import JsonOption, with_run_config
from panolog.scene.errors import InputError

if TYPE_CHECKING:
    from panolog.orchestrator.run.config import RunConfig

app = typer.Typer(no_args_is_help=True, help="Run on a Ray cluster, from any machine that reaches it.")

HeadSceneArg = Annotated[str, typer.Argument(metavar="SCENE", help="Folder of the scene on the head node.")]
HeadRunArg = Annotated[str, typer.Argument(metavar="RUN", help="Folder of the run on the head node.")]
HeadRunOption = Annotated[
    str, typer.Option("--output", "-o", metavar="RUN", help="Folder of the new run on the head node.")
]
ServerOption = Annotated[
    str,
    typer.Option(
        "--address",
        metavar="http://HOST:8265",
        envvar="RAY_API_SERVER_ADDRESS",
        help="The cluster's Ray dashboard, which is its job server.",
    ),
]
_LOCAL = "http://127.0.0.1:8265"


@app.command()
@with_run_config
def submit(
    scene: HeadSceneArg,
    output: HeadRunOption,
    config: "RunConfig",
    address: ServerOption = _LOCAL,
    as_json: JsonOption = False,
) -> None:
    """Start `panolog run` on the cluster, with the same options. F.yaml is read on this machine."""
    from panolog.orchestrator.cluster.jobs import as_settings, on_head

    scene, run = on_head(scene, "SCENE"), on_head(output, "--output")
    _start(address, run, ["run", scene, "-o", run, *as_settings(config)], as_json=as_json)


@app.command()
def resume(run: HeadRunArg, address: ServerOption = _LOCAL, as_json: JsonOption = False) -> None:
    """Resume a run on the cluster from its last checkpoints."""
    from panolog.orchestrator.cluster.jobs import on_head

    run = on_head(run, "RUN")
    _start(address, run, ["resume", run], as_json=as_json)


@app.command()
def status(run: HeadRunArg, address: ServerOption = _LOCAL, as_json: JsonOption = False) -> None:
    """Show how far a run on the cluster is: its job and the output of `panolog status` there."""
    from panolog.orchestrator.cluster.jobs import connect, on_head

    run = on_head(run, "RUN")
    cluster = connect(address)
    job = cluster.job_of(run)
    columns = f"COLUMNS={get_terminal_size().columns}"  # a table as wide as this terminal
    command = ["panolog", "status", run]
    code, output = cluster.call([*command, "--json"] if as_json else ["env", columns, *command])
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
        print(f"job {job.id} · {job.status}" + (f" · {job.reason}" if job.reason else ""))
    if output:
        print(output)


@app.command()
def stop(run: HeadRunArg, address: ServerOption = _LOCAL, as_json: JsonOption = False) -> None:
    """Stop a run on the cluster as Ctrl-C does; returns when its checkpoints are written."""
    from panolog.orchestrator.cluster.jobs import connect, on_head

    run = on_head(run, "RUN")
    job = connect(address).stop(run)
    if as_json:
        print_json({"run": run, "job": asdict(job)})
    else:
        say(f"job {job.id}: {job.status}; `panolog cluster resume {run}` resumes it")


def _start(address: str, run: str, command: Sequence[str], *, as_json: bool) -> None:
    from panolog.orchestrator.cluster.jobs import connect

    cluster = connect(address)
    job = cluster.begin(run, ["panolog", *command, "--address", "auto"])
    if not cluster.guarded:
        say(f"{cluster.address} requires no token: any program that reaches it can run code on the cluster")
    if as_json:
        print_json({"run": run, "address": cluster.address, "job": asdict(job)})
    else:
        print(job.id)
        say(f"started; `panolog cluster status {run} --address {cluster.address}` shows its status")
