"""A run from its start or from where it stopped: checks, lock, pool, driver."""

import os
import socket
import sqlite3
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager, suppress
from pathlib import Path

from panolog.orchestrator.driver.driver import Driver, Hooks
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
from panolog.orchestrator.run.state import OnChange, RunState, replay
from panolog.orchestrator.run.store import Database
from panolog.orchestrator.views.plan_picture import write_plan_picture
from panolog.orchestrator.views.report import report_or_notice
from panolog.partition.plan import Plan
from panolog.renderer.process import choose_device
from panolog.scene.errors import ConfigError, DeviceError
from panolog.scene.files import remove_partial
from panolog.scene.gaussians import Gaussians
from panolog.scene.model import Scene
from panolog.scene.read import read_scene


def start(
    scene_path: Path,
    root: Path,
    config: RunConfig,
    address: str | None,
    on_change: OnChange,
    pool: Pool | None = None,
) -> RunState:
    """Runs a scene into the new run folder `root`, to the end.

    Args: address of a Ray cluster, None for Ray on this machine; pool, where tasks run instead, without Ray.
    Raises InputError for anything that the user must fix, with `root` untouched if that is found before the
    start; RunError if the run failed.
    """
    scene = read_scene(scene_path)
    config = _with_width(scene, config)
    run_info.check_output(root, scene.fingerprint)
    folder = RunFolder(root)
    with _workers(address, root, pool) as workers:
        preflight = _examine(workers, scene, config, root, local=address is None)
        preflight.require()
        config = preflight.config
        run_folder.make(root)
        with lock.hold(folder.lock):
            run_info.check_output(root, scene.fingerprint)  # another driver may have been quicker
            reference = SceneRef(path=str(scene.root), fingerprint=scene.fingerprint, offset=scene.offset)
            run_folder.write_json(folder.preflight, preflight.as_json())
            run_info.write_info(folder, run_info.make_info(reference, config))
            with closing(Database(folder.database)) as database:
                stored = database.append(
                    [Noticed(Part.PREFLIGHT, preflight.summary()), *control.begin(folder)]
                )
                on_change = on_change if pool else _exported(root, on_change)
                on_change(replay(stored), stored)
                job = Job(folder, scene, config)
                return _drive(job, database, workers, on_change, resumed=False)


def resume(root: Path, address: str | None, on_change: OnChange, pool: Pool | None = None) -> RunState:
    """Resumes a run, to the end; does nothing if it is done. Args: as `start`.

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
        with _workers(address, root, pool) as workers:
            _device(info.config.device, workers, local=address is None)
            on_change = on_change if pool else _exported(root, on_change)
            job = Job(folder, scene, info.config)
            return _drive(job, database, workers, on_change, resumed=True)


def estimate_run(scene_path: Path, config: RunConfig, address: str | None) -> tuple[Scene, Preflight]:
    """What a run of a scene would need, on this machine or on a cluster, with its folder in the current one.

    Raises InputError as `start`, except if the run does not fit: that is the problem of the preflight.
    """
    scene = read_scene(scene_path)
    config = _with_width(scene, config)
    with _workers(address, scene.root, None) as pool:
        return scene, _examine(pool, scene, config, Path.cwd(), local=address is None)


def _examine(pool: Pool, scene: Scene, config: RunConfig, root: Path, *, local: bool) -> Preflight:
    device = _device(config.device, pool, local=local)
    return examine(pool, scene, config.model_copy(update={"device": device}), root)


@contextmanager
def _workers(address: str | None, root: Path, pool: Pool | None) -> Iterator[Pool]:
    """The pool that is given, else Ray's."""
    if pool is not None:
        yield pool
        return
    from panolog.orchestrator.cluster.connection import connect  # noqa: PLC0415  # other pools need no Ray

    with connect(address, root) as ray_pool:
        yield ray_pool


def _exported(root: Path, on_change: OnChange) -> OnChange:
    """`on_change`, which also exports the state as metrics of Ray."""
    from panolog.orchestrator.cluster.telemetry import Telemetry  # noqa: PLC0415

    telemetry = Telemetry(root)

    def both(state: RunState, news: Sequence[Stored]) -> None:
        telemetry.show(state, news)
        on_change(state, news)

    return both


def _drive(job: Job, database: Database, pool: Pool, on_change: OnChange, *, resumed: bool) -> RunState:
    began, folder = RunBegan(socket.gethostname(), os.getpid(), resumed), job.folder

    def draw(plan: Plan, coarse: Gaussians) -> None:
        write_plan_picture(folder.plan_picture, plan, coarse.means[coarse.scene].numpy())

    with on_signals() as stop:
        try:
            return Driver(job, database, pool, Hooks(on_change, draw), stop).run(began)
        finally:
            _report(folder, database, on_change)


def _report(folder: RunFolder, database: Database, on_change: OnChange) -> None:
    """Writes the report of a run that has been evaluated. A full disk has been reported already."""
    with suppress(sqlite3.Error):
        state = replay(database.milestones())
        if state.metrics is not None and (stored := database.append(report_or_notice(folder))):
            on_change(state, stored)


def _with_width(scene: Scene, config: RunConfig) -> RunConfig:
    width = config.width or scene.width
    if width > scene.width:
        raise ConfigError(f"--width {width}: the panoramas have {scene.width} pixels; give at most that")
    return config.model_copy(update={"width": width})


def _device(wanted: str, pool: Pool, *, local: bool) -> str:
    """The device that "auto" means here. Raises InputError if CUDA is wanted and there is none."""
    if local:
        return choose_device(wanted)
    gpus = any(node.gpus for node in pool.nodes())
    if wanted == "cuda" and not gpus:
        raise DeviceError("--device cuda: no node of the cluster has a GPU; see `ray status`")
    return "cuda" if wanted != "cpu" and gpus else "cpu"
