"""`panolog queue`: runs one after another, or side by side. Separate: a group of commands."""

import inspect
import os
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from panolog.orchestrator.cli import run as runs
from panolog.orchestrator.cli.console import command, print_result, progress_bar, say
from panolog.orchestrator.cli.options import BUDGET, JsonOption, followed, preparation, run_config, wanted
from panolog.orchestrator.cli.syntax import Command, Group, argument, flag, option
from panolog.scene.errors import QueueError

if TYPE_CHECKING:
    from panolog.orchestrator.runs.queue.entries import Needs

_KEPT = {"prices", "max_cost", "deadline", "local", "force"}  # the run itself has them, or a queue has none
app = typer.Typer(
    cls=Group, no_args_is_help=True, help="A queue of runs: add, list, move, remove, retry, run."
)
QueueOption = Annotated[
    Path | None,
    option(
        "DIR",
        "Folder of the queue, on a disk of this machine. Default: PANOLOG_QUEUE, or"
        " ~/.local/state/panolog/queue.",
        "--queue",
    ),
]
_share = partial(option, panel="Share of the machine (docs/queue.md)")
GpusOption = Annotated[
    int | None,
    _share(
        "N", "GPUs that the run has for itself. Default: an even part; 0 with --device cpu.", min=0, max=1024
    ),
]
CoresOption = Annotated[
    int | None,
    _share("N", "CPU cores that the run has for itself. Default: an even part.", min=1, max=65_536),
]
RamOption = Annotated[
    float | None,
    _share(
        "GIB",
        "Main memory of this machine that the run may use. Default: an even part.",
        "--ram",
        min=0.1,
        max=1e6,
    ),
]
QueuedDeadlineOption = Annotated[
    str | None,
    option(
        "6h|08:00",
        "The same, so that all is done at a time, or so long from the start of the run, not from now;"
        " 08:00 is the next one after its start.",
        "--deadline",
        panel=BUDGET,
    ),
]
IdArg = Annotated[int, argument("ID", "Number of an entry; see `queue list`.", min=1)]


@app.callback()
def _queue() -> None:
    """A queue of runs."""


def _as_run(command: Callable[..., None]) -> Callable[..., None]:
    """A command with the arguments and options of `panolog run`, those that `run` may get later too."""
    own = inspect.signature(command).parameters
    fixed = [parameter for parameter in own.values() if parameter.kind != inspect.Parameter.VAR_KEYWORD]
    parameters = [*fixed[:1], *inspect.signature(runs.run).parameters.values(), *fixed[1:]]
    parameters = [it.replace(kind=inspect.Parameter.KEYWORD_ONLY) for it in parameters]
    parameters = [
        it.replace(annotation=QueuedDeadlineOption) if it.name == "deadline" else it for it in parameters
    ]
    command.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]  # read by typer
    command.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
    return command


@app.command(cls=Command)
@_as_run
def add(
    context: typer.Context,
    queue: QueueOption = None,
    gpus: GpusOption = None,
    cores: CoresOption = None,
    ram: RamOption = None,
    **given: Any,
) -> None:
    """Add a run to the queue: the arguments and options of `panolog run`."""
    from panolog.orchestrator.runs.queue.database import opened
    from panolog.orchestrator.runs.queue.entries import Command as Words

    given |= _absolute(given)
    root = Path(given["output"])
    needs = _needs(_check(given), given["address"], {"--gpus": gpus, "--cores": cores, "--ram": ram})
    first = tuple(_words(context, given, inspect.signature(runs.run).parameters))
    resumes = inspect.signature(runs.resume).parameters.keys() - _KEPT
    later = tuple(_words(context, given, resumes))
    with opened(_folder(queue)) as found:
        print(found.add(Words(root, first, later, Path.cwd(), needs)))


@app.command("list", cls=Command)
def list_(
    queue: QueueOption = None,
    all_: Annotated[bool, flag("Also show entries that were removed.", "--all")] = False,
    as_json: JsonOption = False,
) -> None:
    """Show the entries of the queue in order."""
    from panolog.orchestrator.runs.queue.database import opened
    from panolog.orchestrator.runs.queue.view import view_queue

    with opened(_folder(queue), make=False) as found:
        shown = view_queue(found, removed=all_)
    print_result(shown.as_json(), shown.lines(), as_json=as_json)


@app.command(cls=Command)
def move(
    id: IdArg,
    before: Annotated[int | None, option("ID", "Before this entry.", min=1)] = None,
    first: Annotated[bool, flag("To the begin.", "--first")] = False,
    last: Annotated[bool, flag("To the end.", "--last")] = False,
    queue: QueueOption = None,
) -> None:
    """Move an entry that waits."""
    from panolog.orchestrator.runs.queue.database import opened
    from panolog.orchestrator.runs.queue.entries import State

    if (before is not None) + first + last != 1:
        raise QueueError("queue move: give one of --before ID, --first and --last")
    with opened(_folder(queue), make=False) as found:
        if first:
            before = next((it.id for it in found.entries() if it.state == State.WAITING), id)
        found.move(id, before)


@app.command(cls=Command)
def remove(id: IdArg, queue: QueueOption = None) -> None:
    """Remove an entry that is not running; its run folder stays."""
    from panolog.orchestrator.runs.queue.database import opened
    from panolog.orchestrator.runs.queue.view import remove_entry

    with opened(_folder(queue), make=False) as found:
        remove_entry(found, id)


@app.command(cls=Command)
def retry(
    id: IdArg,
    queue: QueueOption = None,
    gpus: GpusOption = None,
    cores: CoresOption = None,
    ram: RamOption = None,
) -> None:
    """Let a run that has failed or was stopped wait again; it is resumed. Options replace its share."""
    from dataclasses import replace

    from panolog.orchestrator.runs.queue.database import opened

    memory = None if ram is None else int(ram * 2**30)
    values = {"gpus": gpus, "cores": cores, "memory": memory}
    changes: dict[str, Any] = {name: value for name, value in values.items() if value is not None}
    with opened(_folder(queue), make=False) as found:
        needs = found.entry(id).command.needs
        if changes and needs is None:
            raise QueueError(f"entry {id} is a run on a cluster, which Ray divides; leave the options out")
        found.retry(id, replace(needs, **changes) if changes and needs is not None else None)


@app.command(cls=Command)
def run(
    at_once: Annotated[
        int, option("N", "Runs side by side at most; each has its share of the machine.", min=1, max=64)
    ] = 1,
    wait: Annotated[bool, flag("Wait for new entries when none is left, until a signal.", "--wait")] = False,
    queue: QueueOption = None,
) -> None:
    """Run what waits, in order; first resume what was running."""
    from panolog.orchestrator.runs.queue.database import opened
    from panolog.orchestrator.runs.queue.runner import Limits, run_queue, sole_runner

    folder = _folder(queue)
    with opened(folder) as found, sole_runner(folder):
        code = run_queue(found, Limits(at_once, forever=wait), lambda line: say(f"panolog: {line}"))
    raise typer.Exit(code)


def _folder(given: Path | None) -> Path:
    from panolog.orchestrator.runs.queue.database import default_folder

    return default_folder() if given is None else given.absolute()


def _absolute(given: dict[str, Any]) -> dict[str, str | list[str]]:
    """Arguments that are paths: `run` takes URLs as well. Raises QueueError for `--local`."""
    if given["local"] is not None:
        raise QueueError("--local: is for runs with a URL, which a queue does not take; leave it out")
    names = [name for name in ("output", "prices") if given[name] is not None]
    sources = [str(Path(source).resolve()) for source in given["source"]]
    return {"source": sources} | {name: str(Path(given[name]).resolve()) for name in names}


def _needs(device: str, address: str | None, given: dict[str, Any]) -> "Needs | None":
    """What the run is to get of this machine; None if it is on a cluster.

    Args: given, by option. Raises QueueError for options that contradict the run's own.
    """
    from panolog.orchestrator.runs.queue.entries import Needs

    gpus, cores, ram = given.values()
    if address is not None:
        for name, value in given.items():
            if value is not None:
                raise QueueError(f"{name} {value}: with --address Ray divides the cluster; leave it out")
        return None
    if device == "cpu" and gpus:
        raise QueueError(f"--gpus {gpus}: the run computes on the CPU (device=cpu); leave it out")
    if device == "cuda" and gpus == 0:
        raise QueueError("--gpus 0: the run computes on a GPU (device=cuda); give 1 or more")
    return Needs(0 if device == "cpu" else gpus, cores, None if ram is None else int(ram * 2**30))


def _check(given: dict[str, Any]) -> str:
    """Everything that `panolog run` checks before it trains. Returns the device of the settings.

    Raises InputError as it does.
    """
    from panolog.orchestrator.watch.follower.recipients import read_recipients

    def made(make: Callable[..., Any]) -> Any:
        return make(**{name: given[name] for name in inspect.signature(make).parameters})

    config, options, (notify, log) = made(run_config), made(preparation), made(followed)
    read_recipients(notify, log, os.environ)
    made(wanted)
    output = Path(given["output"])
    if (output / "run.json").exists():
        raise QueueError(
            f"{output}: is a run already; {command('resume', output)} resumes it, or give another -o"
        )
    with progress_bar("checking the scene"):
        from panolog.orchestrator.cli.session import preparing

        preparing.found(given["source"], config, options).check_output(output)
    return str(config.device)


def _words(context: typer.Context, given: dict[str, Any], wanted: Any) -> Iterator[str]:
    """What was given of some parameters as words, with absolute paths; `queue run` supervises anyway."""
    for parameter in context.command.params:
        name = parameter.name or ""
        value = given.get(name)
        unset = value in (None, (), []) or value == parameter.default
        if name in wanted and name != "supervise" and not unset:
            for one in value if isinstance(value, list) else [value]:
                yield from _option(parameter, one)


def _option(parameter: Any, value: Any) -> Iterator[str]:
    if isinstance(value, bool):
        yield parameter.opts[0] if value else parameter.secondary_opts[0]
        return
    if parameter.opts[0].startswith("-"):
        yield parameter.opts[0]
    for part in value if isinstance(value, tuple) else (value,):
        yield str(part.resolve() if isinstance(part, Path) else part)
