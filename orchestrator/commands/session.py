"""A run from its beginning or from where it stopped: checks, lock, Ray, driver."""

import os
import socket
import sqlite3
from collections.abc import Sequence
from contextlib import closing, suppress
from pathlib import Path

from panolog.orchestrator.cluster.connection import connect
from panolog.orchestrator.cluster.telemetry import Telemetry
from panolog.orchestrator.driver.driver import Driver, Show
from panolog.orchestrator.driver.job import Job, scene_of
from panolog.orchestrator.driver.stopping import on_signals
from panolog.orchestrator.resources.pool import Pool
from panolog.orchestrator.resources.preflight import Preflight, examine
from panolog.orchestrator.run import control, lock
from panolog.orchestrator.run import folder as run_folder
from panolog.orchestrator.run import info as run_info
from panolog.orchestrator.run.config import RunConfig
from panolog.orchestrator.run.folder import RunFolder
from panolog.orchestrator.run.info import SceneRef
from panolog.orchestrator.run.records import Noticed, Outcome, Part, RunBegan, Stored
from panolog.orchestrator.run.state import RunState, replay
from panolog.orchestrator.run.store import Database
from panolog.orchestrator.views.report import report_or_notice
from panolog.renderer.process import choose_device
from panolog.scene.errors import InputError
from panolog.scene.files import remove_partial
from panolog.scene.model import Scene
from panolog.scene.read import read_scene


def start(scene_path: Path, root: Path, config: RunConfig, address: str | None, show: Show) -> RunState:
    """Runs a scene into the new run folder `root`, to the end.

    Args: address of a Ray cluster, None for this machine; show is told of every change of state.
    Raises InputError for anything the user must mend, with `root` untouched if it shows before the start;
    RunError if the run failed.
    """
    scene = read_scene(scene_path)
    config = _with_width(scene, config)
    run_info.check_output(root, scene.fingerprint)
    folder = RunFolder(root)
    with connect(address, root) as pool:
        preflight = _examine(pool, scene, config, root, local=address is None)
        preflight.require()
        config = preflight.config
        run_folder.make(root)
        with lock.hold(folder.lock):
            run_info.check_output(root, scene.fingerprint)  # another driver may have been quicker
            reference = SceneRef(path=str(scene.root), fingerprint=scene.fingerprint)
            run_folder.write_json(folder.preflight, preflight.as_json())
            run_info.write_info(folder, run_info.make_info(reference, config))
            with closing(Database(folder.database)) as database:
                stored = database.append(
                    [Noticed(Part.PREFLIGHT, preflight.summary()), *control.begin(folder)]
                )
                show(replay(stored), stored)
                return _drive(Job(folder, scene, config), database, pool, show, resumed=False)


def resume(root: Path, address: str | None, show: Show) -> RunState:
    """Goes on with a run, to the end; does nothing if it is done.

    Raises InputError if `root` is no run, its scene has changed or is gone, its device is missing or another
    driver is at work on it; RunError if the run failed.
    """
    folder = RunFolder(root)
    info = run_info.read_info(folder)
    with lock.hold(folder.lock), closing(Database(folder.database)) as database:
        state = replay(database.milestones())
        if state.outcome == Outcome.DONE:
            return state
        scene = scene_of(info)
        remove_partial(root)
        database.append(control.begin(folder))
        with connect(address, root) as pool:
            _device(info.config.device, pool, local=address is None)
            return _drive(Job(folder, scene, info.config), database, pool, show, resumed=True)


def look(scene_path: Path, config: RunConfig, address: str | None) -> tuple[Scene, Preflight]:
    """What a run of a scene would need, on this machine or on a cluster, its folder being in this one.

    Raises InputError as `start`, but for what does not fit: the preflight says it.
    """
    scene = read_scene(scene_path)
    config = _with_width(scene, config)
    with connect(address, scene.root) as pool:
        return scene, _examine(pool, scene, config, Path.cwd(), local=address is None)


def _examine(pool: Pool, scene: Scene, config: RunConfig, root: Path, *, local: bool) -> Preflight:
    device = _device(config.device, pool, local=local)
    return examine(pool, scene, config.model_copy(update={"device": device}), root)


def _drive(job: Job, database: Database, pool: Pool, show: Show, *, resumed: bool) -> RunState:
    began = RunBegan(socket.gethostname(), os.getpid(), resumed)
    telemetry = Telemetry(job.folder.root)

    def tell(state: RunState, news: Sequence[Stored]) -> None:
        telemetry.show(state, news)
        show(state, news)

    with on_signals() as stop:
        try:
            return Driver(job, database, pool, tell, stop).run(began)
        finally:
            _report(job.folder, database, tell)


def _report(folder: RunFolder, database: Database, show: Show) -> None:
    """Writes the report of a run that has been evaluated. A full disk has been complained of already."""
    with suppress(sqlite3.Error):
        state = replay(database.milestones())
        if state.metrics is not None and (stored := database.append(report_or_notice(folder))):
            show(state, stored)


def _with_width(scene: Scene, config: RunConfig) -> RunConfig:
    width = config.width or scene.width
    if width > scene.width:
        raise InputError(f"--width {width}: the panoramas have {scene.width} pixels; give at most that")
    return config.model_copy(update={"width": width})


def _device(wanted: str, pool: Pool, *, local: bool) -> str:
    """The device that "auto" means here. Raises InputError if CUDA is wanted and there is none."""
    if local:
        return choose_device(wanted)
    gpus = any(node.gpus for node in pool.nodes())
    if wanted == "cuda" and not gpus:
        raise InputError("--device cuda: no node of the cluster has a GPU; see `ray status`")
    return "cuda" if wanted != "cpu" and gpus else "cpu"
