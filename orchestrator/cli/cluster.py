"""`panolog cluster`: the same job on a Ray cluster, from any machine that reaches its job server."""

import json
from collections.abc import Sequence
from dataclasses import asdict
from shutil import get_terminal_size
from typing import Annotated, Any

import typer

from panolog.orchestrator.cli.app import (
    BlocksOption,
    ConfigOption,
    DeviceOption,
    IterationsOption,
    JsonOption,
    SetOption,
    WidthOption,
    app,
    print_json,
    say,
)
from panolog.scene.errors import InputError

cluster_app = typer.Typer(no_args_is_help=True, help="The same job on a Ray cluster, from afar.")
app.add_typer(cluster_app, name="cluster")

HeadSceneArg = Annotated[str, typer.Argument(metavar="SCENE", help="Folder of the scene on the head node.")]
HeadRunArg = Annotated[str, typer.Argument(metavar="RUN", help="Folder of the run on the head node.")]
ServerOption = Annotated[
    str,
    typer.Option(
        "--address",
        metavar="http://HOST:8265",
        envvar="RAY_API_SERVER_ADDRESS",
        help="The cluster's dashboard, which is its job server.",
    ),
]
_HERE = "http://127.0.0.1:8265"


@cluster_app.command()
def submit(
    scene: HeadSceneArg,
    output: Annotated[
        str, typer.Option("--output", "-o", metavar="RUN", help="Folder of the new run on the head node.")
    ],
    config: ConfigOption = None,
    settings: SetOption = None,
    blocks: BlocksOption = None,
    iterations: IterationsOption = None,
    width: WidthOption = None,
    device: DeviceOption = None,
    address: ServerOption = _HERE,
    as_json: JsonOption = False,
) -> None:
    """Start `panolog run` on the cluster, with the same options. F.yaml is read here."""
    from panolog.orchestrator.cluster.jobs import as_settings, on_head
    from panolog.orchestrator.run.config import load_config

    flags = {"blocks": blocks, "iterations": iterations, "width": width, "device": device}
    resolved = load_config(config, settings or (), flags)
    scene, run = on_head(scene, "SCENE"), on_head(output, "--output")
    _begin(address, run, ["run", scene, "-o", run, *as_settings(resolved)], as_json=as_json)


@cluster_app.command()
def resume(run: HeadRunArg, address: ServerOption = _HERE, as_json: JsonOption = False) -> None:
    """Go on with a run on the cluster from its last checkpoints."""
    from panolog.orchestrator.cluster.jobs import on_head

    run = on_head(run, "RUN")
    _begin(address, run, ["resume", run], as_json=as_json)


@cluster_app.command()
def status(run: HeadRunArg, address: ServerOption = _HERE, as_json: JsonOption = False) -> None:
    """How a run on the cluster stands: what `panolog status` says there, and its job."""
    from panolog.orchestrator.cluster.jobs import connect, on_head

    run = on_head(run, "RUN")
    cluster = connect(address)
    job = cluster.job_of(run)
    columns = f"COLUMNS={get_terminal_size().columns}"  # a table as wide as this terminal
    command = ["panolog", "status", run]
    code, said = cluster.call([*command, "--json"] if as_json else ["env", columns, *command])
    state: dict[str, Any] = {}
    if code == 0:
        state = json.loads(said) if as_json else state
    elif job is None:
        raise InputError(said.removeprefix("panolog: "))
    else:  # a job that has not made its run folder yet, or could not, speaks for the run
        said, state = "", {"run": run, "status": job.status, "reason": job.reason}
    if as_json:
        print_json(state | {"job": job and asdict(job)})
        return
    if job:
        print(f"job {job.id} · {job.status}" + (f" · {job.reason}" if job.reason else ""))
    if said:
        print(said)


@cluster_app.command()
def stop(run: HeadRunArg, address: ServerOption = _HERE, as_json: JsonOption = False) -> None:
    """End a run on the cluster as Ctrl-C would; waits until its checkpoints are written."""
    from panolog.orchestrator.cluster.jobs import connect, on_head

    run = on_head(run, "RUN")
    job = connect(address).stop(run)
    if as_json:
        print_json({"run": run, "job": asdict(job)})
    else:
        say(f"job {job.id}: {job.status}; `panolog cluster resume {run}` goes on")


def _begin(address: str, run: str, command: Sequence[str], *, as_json: bool) -> None:
    from panolog.orchestrator.cluster.jobs import connect

    cluster = connect(address)
    job = cluster.begin(run, ["panolog", *command, "--address", "auto"])
    if not cluster.guarded:
        say(f"{cluster.address} asks for no token: whoever reaches it can run programs on the cluster")
    if as_json:
        print_json({"run": run, "address": cluster.address, "job": asdict(job)})
    else:
        print(job.id)
        say(f"started; `panolog cluster status {run} --address {cluster.address}` tells how it stands")
