"""A run from its start to its end: run, resume, demo, doctor, status, events."""

import json
import os
import time
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from panolog.orchestrator.cli.console import (
    command,
    err,
    print_json,
    print_result,
    progress_bar,
    say,
    say_results,
)
from panolog.orchestrator.cli.options import (
    AcceptOption,
    AddressOption,
    AnyRunArg,
    AtEndOption,
    DriverOptions,
    JsonOption,
    LocalOption,
    PricesOption,
    SourcesArg,
    driving,
    followed,
    grouped,
    preparation,
    run_config,
    wanted,
)
from panolog.orchestrator.cli.stores import mirrored, opened
from panolog.orchestrator.cli.syntax import argument, flag, option

if TYPE_CHECKING:
    from panolog.orchestrator.runs.config import RunConfig
    from panolog.orchestrator.runs.money.limits import Wanted
    from panolog.orchestrator.runs.preparation.settings import Options

_POLL = 0.5  # seconds between two reads of a live run


@grouped(config=run_config, options=preparation, driver=driving, targets=followed, budget=wanted)
def run(
    source: SourcesArg,
    output: Annotated[str, option("RUN", "Folder or URL of the new run.", "--output", "-o")],
    *,
    config: "RunConfig",
    options: "Options",
    driver: DriverOptions,
    targets: tuple[list[str], list[str]],
    local: LocalOption = None,
    budget: "Wanted",
    at_end: AtEndOption = None,
) -> None:
    """Reconstruct a scene, or panoramas and 360° videos, also several: one model of the place."""
    from panolog.orchestrator.cli.session.at_end import when_ended
    from panolog.orchestrator.runs.config import as_settings
    from panolog.orchestrator.runs.preparation.settings import as_arguments

    code, state = 0, None
    with when_ended(at_end, _complain) as begun:
        with mirrored(output, local) as root, _followed(root, *targets):
            begun(root)
            if driver.resumes is not None:
                first = ["run", *source, "-o", str(root), *as_settings(config), *as_arguments(options)]
                code = _supervise(root, first, driver, driver.resumes, budget.options())
            else:
                with _session(root, output, dashboard=driver.dashboard) as (session, show):
                    given = source if len(source) > 1 else source[0]
                    machine = driver.address, show, None, driver.nice
                    state = session.start(given, root, config, *machine, options, budget)
        _end(root, code, state)


@grouped(driver=driving, targets=followed, budget=wanted)
def resume(
    run: AnyRunArg,
    *,
    driver: DriverOptions,
    targets: tuple[list[str], list[str]],
    local: LocalOption = None,
    force: Annotated[
        bool, flag("Take a run with a URL from a driver that may still be at work.", "--force")
    ] = False,
    accept_changes: AcceptOption = False,
    budget: "Wanted",
    at_end: AtEndOption = None,
    after: Annotated[str, typer.Option("--resumed-after", hidden=True)] = "",
    has_mirror: Annotated[bool, typer.Option("--has-mirror", hidden=True)] = False,
) -> None:
    """Resume a run from its last checkpoints."""
    from panolog.orchestrator.cli.session.at_end import when_ended
    from panolog.orchestrator.runs.folder import RunFolder
    from panolog.orchestrator.runs.info import read_info

    code, state = 0, None
    with when_ended(at_end, _complain) as begun:
        with mirrored(run, local, resumes=True, force=force, mirror=not has_mirror) as root:
            begun(root)
            read_info(RunFolder(root))  # fails before torch is imported
            with _followed(root, *targets):
                if driver.resumes is not None:
                    first = ["resume", str(root), "--has-mirror"]
                    once = budget.options() + ["--accept-changes"] * accept_changes
                    code = _supervise(root, first, driver, driver.resumes, once)
                else:
                    with _session(root, run, dashboard=driver.dashboard) as (session, show):
                        given = (root, driver.address, show, None, driver.nice, after, budget)
                        state = session.resume(*given, accept_changes=accept_changes)
        _end(root, code, state)


def demo(
    output: Annotated[
        Path | None,
        option(
            "RUN",
            "Folder of the run; its scene is written next to it.",
            "--output",
            "-o",
            show_default="runs/demo, runs/flight or runs/city",
        ),
    ] = None,
    address: AddressOption = None,
    flight: Annotated[
        bool,
        flag(
            "A flight over nine blocks of houses instead of a street; with --city, above it too.", "--flight"
        ),
    ] = False,
    city: Annotated[
        int | None,
        option("K", "A city of so many panoramas: a drive along all its streets.", min=2, max=20_000),
    ] = None,
) -> None:
    """Reconstruct a synthetic place: a small town, minutes on two CPU cores."""
    root = output or Path("runs", "city" if city else "flight" if flight else "demo")
    with progress_bar("starting") as count:
        from panolog.orchestrator.cli.commands.demo import demo_of, make_place, run_demo

        place = demo_of(flight=flight, city=city)
        scene = make_place(root, place, lambda done, total: count(f"rendering {place.title}", done, total))
    with _display(root, str(root)) as show:
        state = run_demo(scene, root, place, address, show)
    say_results(root, state)


@grouped(config=run_config)
def doctor(
    config: "RunConfig",
    scene: Annotated[
        list[str] | None,
        argument(
            "SCENE|SOURCE...",
            "Also estimate what a run of this scene (folder or URL) needs, or check the panoramas and"
            " videos.",
        ),
    ] = None,
    address: AddressOption = None,
    prices: PricesOption = None,
    as_json: JsonOption = False,
) -> None:
    """Check this machine; with SCENE, also estimate what a run needs."""
    found = wanted(prices, None, None).prices
    with progress_bar("checking this machine" if not scene else "measuring on the machine that will train"):
        from panolog.orchestrator.cli.commands.doctor import diagnose

        diagnosis = diagnose(scene, config, address, found)
    print_result(diagnosis.as_json(), diagnosis.lines(), as_json=as_json)
    if not diagnosis.ready:
        raise typer.Exit(2)


def status(run: AnyRunArg, as_json: JsonOption = False) -> None:
    """Show how far a run is, live or ended."""
    with opened(run, "status") as (root, live):
        _status(root, run, live=live, as_json=as_json)


def _status(root: Path, run: str, *, live: bool, as_json: bool) -> None:
    """Prints the state of a run. Args: run, its name in commands; live, whether a driver elsewhere has it."""
    from dataclasses import replace

    from panolog.orchestrator.runs import lock, presence
    from panolog.orchestrator.runs.folder import RunFolder, head_of, read_json
    from panolog.orchestrator.runs.info import read_history
    from panolog.orchestrator.runs.state import replay
    from panolog.orchestrator.runs.storage.state import read_state
    from panolog.orchestrator.watch.views.preparation import view_preparation, with_step
    from panolog.orchestrator.watch.views.summary import summarize

    folder = RunFolder(root)
    info = read_json(folder)
    scene, width = head_of(folder, info)
    running = live or lock.held(folder.lock)
    mirror = read_state(folder.mirror, running=running)
    state = replay(read_history(folder))
    if running and not state.waiting:  # a full disk takes no record of it
        state = replace(state, waiting=presence.waiting(folder.presence))
    prepared = view_preparation(folder, state, running=running)
    state = with_step(state, prepared)
    summary = summarize(state, running=running, root=run, prepared=prepared.over if prepared else None)
    if as_json:
        head = {"run": run, "scene": scene, "width": width}
        head |= {"preparation": prepared.model_dump(mode="json")} if prepared else {}
        head |= {"store": vars(mirror) | {"lag": mirror.lag}} if mirror else {}
        print_json(head | summary.model_dump(mode="json"))
        return
    from rich import get_console

    from panolog.orchestrator.watch.views.terminal import WIDE, page

    console = get_console()
    shown = page(summary, root=run, wide=console.width >= WIDE)
    console.print(shown, crop=False)  # a command longer than a line is whole
    if mirror:
        console.print(mirror.line, style="yellow" if mirror.late else "dim", markup=False, highlight=False)
    for step in prepared.steps if prepared and not state.prepared else ():
        for line in step.lines:
            console.print(f"{step.label}: {line}", style="dim", markup=False, highlight=False)


def events(
    run: AnyRunArg,
    follow: Annotated[bool, flag("Print new events as long as the run is live.", "--follow")] = False,
) -> None:
    """Print the history of a run as JSON lines."""
    with opened(run, "events") as (root, _):
        _print_events(root, follow=follow)


def _print_events(run: Path, *, follow: bool) -> None:
    from panolog.orchestrator.runs import lock
    from panolog.orchestrator.runs.database import as_event, read_records
    from panolog.orchestrator.runs.folder import RunFolder, read_head

    folder = RunFolder(run)
    read_head(folder)
    last = 0
    while True:
        live = lock.held(folder.lock)  # checked first: events that an ending driver wrote are then read below
        while folder.database.exists() and (records := read_records(folder.database, after=last)):
            for stored in records:
                print(json.dumps(as_event(stored), default=vars, allow_nan=False), flush=True)
            last = records[-1].id
        if not (follow and live):
            return
        time.sleep(_POLL)


def _supervise(root: Path, first: list[str], driver: DriverOptions, resumes: int, limits: list[str]) -> int:
    """Runs drivers as children of this process. Returns the exit code of the last one."""
    from panolog.orchestrator.cli.session.supervise import Supervised, supervise

    first, later = [*first, *driver.words(), *limits], [*driver.words(), "--has-mirror"]
    return supervise(Supervised(root, first, later, limits, driver.address, resumes, _complain))


def _complain(line: str) -> None:
    """Says something about a run that is not at work now."""
    err().show_cursor()  # a driver that was killed in its display has hidden it
    say(f"panolog: {line}", style="red")


@contextmanager
def _followed(root: Path, notify: list[str], log: list[str]) -> Iterator[None]:
    """Follows a run while the context lasts, if that is wanted. Raises ConfigError for wrong options."""
    from panolog.orchestrator.cli.session.companion import companion_follower
    from panolog.orchestrator.watch.follower.recipients import read_recipients

    recipients, secret = read_recipients(notify, log, os.environ)
    for name in secret:  # neither Ray nor a worker gets them
        os.environ.pop(name, None)
    with companion_follower(root, recipients, say):
        yield


@contextmanager
def _session(root: Path, name: str, *, dashboard: bool) -> Iterator[tuple[Any, Any]]:
    """Yields the module that drives runs, and as `_display`. Both it and the dashboard take seconds."""
    from panolog.orchestrator.cli.session.companion import companion_dashboard

    with companion_dashboard(root, say) if dashboard else nullcontext():
        with progress_bar("starting"):
            from panolog.orchestrator.cli.session import session

        with _display(root, name) as show:
            yield session, show


@contextmanager
def _display(root: Path, name: str) -> Iterator[Any]:
    """Shows a run on stderr while the context lasts. Yields what to call with every change of its state.

    Args: name, of the run in commands. If the run is interrupted, says how to resume it and exits with 130.
    Raises RunError for an error that nothing foresees, once the run's history has it.
    """
    from panolog.orchestrator.engine.driver.ending import internal
    from panolog.orchestrator.runs.folder import RunFolder
    from panolog.orchestrator.watch.views.terminal import progress
    from panolog.scene.errors import PanologError, RunError

    try:
        with progress(err(), root) as show:
            yield show
    except KeyboardInterrupt as error:
        if not RunFolder(root).info.exists():
            raise
        say(f"panolog: stopped; {command('resume', name)} resumes the run", style="red")
        raise typer.Exit(130) from error
    except (PanologError, OSError):
        raise
    except Exception as error:
        if not RunFolder(root).info.exists():
            raise
        raise RunError(
            f"{internal(error)}; its traceback is in the last line of {command('events', root)};"
            f" {command('resume', name)} tries again"
        ) from error


def _end(root: Path, code: int, state: Any) -> None:
    """Ends `run` or `resume`. Args: code, of the last supervised driver; state, if there is no supervisor."""
    if state is not None:
        say_results(root, state)
    if code:
        raise typer.Exit(code)
