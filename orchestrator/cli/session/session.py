"""A run from its start or from where it stopped: checks, lock, pool, driver.

What needs torch is imported when the place of a run is shown already: that takes seconds.
"""

import logging
import os
import socket
import sqlite3
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager, nullcontext, suppress
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING

from panolog.orchestrator.cli.session import preparing
from panolog.orchestrator.engine.driver.ending import end_recorded
from panolog.orchestrator.engine.driver.journal import Journal, Patience
from panolog.orchestrator.engine.driver.requests import interruptible, uninterrupted
from panolog.orchestrator.engine.stages.outline import write_outline
from panolog.orchestrator.engine.stages.scenes import scene_of
from panolog.orchestrator.runs import control, lock
from panolog.orchestrator.runs import folder as run_folder
from panolog.orchestrator.runs import info as run_info
from panolog.orchestrator.runs.config import RunConfig
from panolog.orchestrator.runs.database import Database
from panolog.orchestrator.runs.folder import RunFolder
from panolog.orchestrator.runs.info import RunInfo
from panolog.orchestrator.runs.money.account import lost_with_driver
from panolog.orchestrator.runs.money.limits import Wanted
from panolog.orchestrator.runs.money.prices import PriceList
from panolog.orchestrator.runs.money.records import BudgetSet
from panolog.orchestrator.runs.preparation.settings import Options, Settings, read_settings, write_settings
from panolog.orchestrator.runs.presence import Presence, why_waiting
from panolog.orchestrator.runs.records import Noticed, Outcome, Preparing, Record, RunBegan
from panolog.orchestrator.runs.retention.clean import remove_all
from panolog.orchestrator.runs.retention.survey import models_of_parts
from panolog.orchestrator.runs.state import OnChange, RunState, ignore
from panolog.orchestrator.watch.views.pages.report import report_or_notice
from panolog.scene.errors import RunFolderError, RunLockedError, installed
from panolog.scene.files import remove_partial
from panolog.scene.model import Scene

if TYPE_CHECKING:
    from panolog.orchestrator.cli.session.driving import Driving
    from panolog.orchestrator.engine.estimates.preflight import Preflight
    from panolog.orchestrator.engine.scheduling.pool import Pool

_LOG = logging.getLogger(__name__)


@interruptible()
def start(
    source: preparing.Given,
    root: Path,
    config: RunConfig,
    address: str | None,
    on_change: OnChange,
    pool: "Pool | None" = None,
    nice: int | None = None,
    options: Options | None = None,
    wanted: Wanted | None = None,
) -> RunState:
    """Runs a scene, or the panoramas of a folder or of a video, into the new run folder `root`, to the end.

    The scene may be given by its URL in an object store.

    Args: address of a Ray cluster, None for Ray on this machine; pool, where tasks run instead, without Ray;
    nice, as `cluster.connection.connect`; options, how a scene is made if `source` is none; wanted, limits of
    cost and time, with prices.
    Raises InputError for anything that the user must fix, with `root` as it was if that is found before the
    first task, or before there is anything to resume from; RunError if the run failed.
    """
    budget = (wanted or Wanted()).budget(RunState())
    new = preparing.found(source, config, options or Options())
    new.check_output(root)
    if config.memory is not None or config.device == "cuda":  # importing torch takes seconds
        from panolog.orchestrator.cli.session.driving import require

        require(new.scene, new.config, local=address is None)
    folder = RunFolder(root)
    made = run_folder.make(root)
    with lock.hold(folder.lock), ExitStack() as undo:
        new.check_output(root)  # another driver may have been quicker
        undo.callback(preparing.discard, folder, made)
        info = run_info.make_info(new.reference(folder), new.config, config)
        if new.settings is not None:  # first, so that this can be resumed from now on
            write_settings(folder, new.settings)
            run_info.write_info(folder, info)
        # what a driver has left that was killed during its preflight
        run_info.clear(folder, keep_info=new.settings is not None)
        if new.scene is not None:
            write_outline(folder, new.scene, info.config)  # first: who sees the run sees the place
            run_info.write_info(folder, info)
        with closing(Database(folder.database)) as database:
            begin = _Beginning(folder, Journal(database, on_change), address, pool, nice, new.scene)
            with end_recorded(begin.journal):
                begin.take_over(info.config, budget)
                info = begin.prepare(info, new.settings)
                with begin.workers(lambda: begin.driving.measure(info)) as workers:
                    config = begin.driving.preflight(workers, info)
                    undo.pop_all()  # from here on it is a run
                    return begin.drive(workers, config)


@interruptible()
def resume(
    root: Path,
    address: str | None,
    on_change: OnChange,
    pool: "Pool | None" = None,
    nice: int | None = None,
    after: str = "",
    wanted: Wanted | None = None,
    *,
    accept_changes: bool = False,
) -> RunState:
    """Resumes a run, to the end; does nothing if it is done, or at a limit that stays as it is.

    Args: as `start`; after, why the supervisor resumes it, which becomes a notice; accept_changes, continue
    with other settings in run.json than those that the run was begun with.
    Raises InputError if `root` is no run, its scene or its settings have changed, its device is missing or
    another driver is at work on it; RunError if the run failed.
    """
    folder = RunFolder(root)
    info = run_info.read_info(folder)
    with lock.hold(folder.lock), closing(_opened(folder, info.config)) as database:
        journal = Journal(database, on_change)
        run_info.require_history(folder, empty=journal.state.latest is None)
        budget = (wanted or Wanted()).budget(journal.state)
        if _is_over(journal.state, budget):
            done = journal.state.outcome == Outcome.DONE
            return _retained(folder, journal, info.config) if done else journal.state
        changes: Sequence[str] = ()
        if prepared := journal.state.prepared:
            changes = run_info.changes(folder, info.config, database.milestones(), accept=accept_changes)
        settings = read_settings(folder) if info.scene.fingerprint == run_info.PENDING else None
        scene = None if settings else scene_of(info, folder)
        remove_partial(root)
        begin = _Beginning(folder, journal, address, pool, nice, scene)
        with end_recorded(journal):
            begin.take_over(info.config, budget, resumed=True, changes=changes)
            if after:
                journal.record([Noticed(None, f"resumed by the supervisor after: {after}")])
            info = begin.prepare(info, settings)
            with begin.workers(ignore if prepared else lambda: begin.driving.measure(info)) as workers:
                config = info.config
                if prepared:
                    begin.driving.require_device(workers, config)
                else:
                    config = begin.driving.preflight(workers, info)
                return begin.drive(workers, config)


def _is_over(state: RunState, budget: BudgetSet | None) -> bool:
    """Whether a driver would have nothing to do. Args: budget, another than before, if there is one."""
    if state.outcome != Outcome.LIMITED:
        return state.outcome == Outcome.DONE
    before = state.money.budget or BudgetSet()
    return budget is None or (budget.max_cost, budget.deadline) == (before.max_cost, before.deadline)


def _opened(folder: RunFolder, config: RunConfig) -> Database:
    """The database of a run; waits for its disk as the driver does. Raises RunFolderError if it is none."""
    said = ""
    while True:
        try:
            return Database(folder.database)
        except RunFolderError as error:
            if not (reason := why_waiting(error, folder.root)):
                raise
            if reason != said:
                _LOG.warning("%s", reason)
            said = reason
            time.sleep(config.disk.retry)


@dataclass
class _Beginning:
    """A driver before its first task. The caller holds the lock."""

    folder: RunFolder
    journal: Journal
    address: str | None
    pool: "Pool | None"
    nice: int | None
    made: Scene | None = None  # None until it is prepared

    @property
    def scene(self) -> Scene:
        """The scene, once there is one."""
        assert self.made is not None  # `prepare` comes first
        return self.made

    @property
    def driving(self) -> "Driving":
        """What the run does with its scene."""
        driving = uninterrupted(import_module, "panolog.orchestrator.cli.session.driving")
        made: Driving = driving.Driving(self.folder, self.journal, self.scene, local=self.address is None)
        return made

    def prepare(self, info: RunInfo, settings: Settings | None) -> RunInfo:
        """Makes the scene of a run that was given none, and returns run.json with it. Raises as `make`."""
        if settings is not None:
            from panolog.orchestrator.cli.session.scene_making import Preparation

            self.made = Preparation(self.folder, settings, info.config, self.journal).make()
            config = preparing.with_width(self.made.width, info.config)
            info = info.model_copy(update={"scene": preparing.reference(self.made), "config": config})
            self.journal.until_done(lambda: run_info.write_info(self.folder, info))
        self.journal.until_done(lambda: write_outline(self.folder, self.scene, info.config))
        return info

    def take_over(
        self,
        config: RunConfig,
        budget: BudgetSet | None,
        *,
        resumed: bool = False,
        changes: Sequence[str] = (),
    ) -> None:
        """Makes this the run's driver, which takes requests and from now on waits for a full disk.

        Args: changes of settings that were accepted.
        """
        presence, state = Presence(self.folder.presence), self.journal.state
        self.journal.patience = Patience(self.folder.root, config.disk.retry, presence)
        settings = config.model_dump(mode="json") if state.prepared else {}
        code, before = run_info.own_code(), state.driver.code if state.driver else ""
        began = RunBegan(socket.gethostname(), os.getpid(), resumed, state.latest, code, settings)
        notices = [f"resumed with other settings: {'; '.join(changes)}"] if changes else []
        if before and before != code:
            notices.append(f"resumed with other sources ({before} → {code}): what is trained now may differ")
        said: list[Record] = [*([budget] if budget else []), *(Noticed(None, line) for line in notices)]
        self.journal.record([*lost_with_driver(state), began, *said, *control.begin(self.folder)])

    @contextmanager
    def workers(self, meanwhile: Callable[[], None]) -> Iterator["Pool"]:
        """The pool that was given, else that of `_workers`: Ray's also exports the state as metrics."""
        exports = self.pool is None and not _works_without_ray(self.address, self.nice)
        if exports:
            what = "connecting to the cluster" if self.address else "starting Ray"
            self.journal.record([Preparing(what)])
        with _workers(self.address, self.folder.root, self.pool, self.nice, meanwhile) as workers:
            if exports:
                from panolog.orchestrator.engine.cluster.run_metrics import RunMetrics

                self.journal.on_change = RunMetrics(self.folder.root, self.journal.on_change).show
            yield workers

    def drive(self, workers: "Pool", config: RunConfig) -> RunState:
        """Runs all tasks, and writes the report."""
        try:
            self.driving.drive(workers, config)
        finally:
            _report(self.folder, self.journal)
        return _retained(self.folder, self.journal, config)


def estimate_run(
    scene: Scene, config: RunConfig, address: str | None, prices: PriceList | None = None
) -> "Preflight":
    """What a run of a scene would need, on this machine or on a cluster, with its folder in the current one.

    Args: config, with a width. Raises InputError as `start`, except if the run does not fit: that is the
    problem of the preflight.
    """
    with _workers(address, scene.root, None, None, ignore) as pool:
        from panolog.orchestrator.cli.session.driving import examined

        return examined(pool, scene, config, Path.cwd(), prices, local=address is None)


@contextmanager
def _workers(
    address: str | None, root: Path, pool: "Pool | None", nice: int | None, meanwhile: Callable[[], None]
) -> Iterator["Pool"]:
    """The pool that is given, else Ray's, or one without Ray; `meanwhile` is called while it starts."""
    if pool is not None or _works_without_ray(address, nice):
        from panolog.orchestrator.engine.driver.local_pool import local_pool

        with local_pool() if pool is None else nullcontext(pool) as here:
            meanwhile()
            yield here
        return
    from panolog.orchestrator.engine.cluster.connection import connect  # other pools need no Ray

    with connect(address, root, nice, meanwhile) as ray_pool:
        yield ray_pool


def _works_without_ray(address: str | None, nice: int | None) -> bool:
    """Whether a run on this machine goes without Ray: it is not installed, and nothing needs it."""
    return address is None and nice is None and not installed("ray")


def _report(folder: RunFolder, journal: Journal) -> None:
    """Writes the report of a run that has ended, however. A full disk has been reported already,
    and in a run that another driver has taken over nothing is written.
    """
    with suppress(sqlite3.Error, RunLockedError):
        journal.database.require_own()
        if notice := report_or_notice(folder):
            journal.record(notice)


def _retained(folder: RunFolder, journal: Journal, config: RunConfig) -> RunState:
    """The state of a run that is done, once the models that its settings do not keep are removed."""
    if not config.retention.models and (
        notice := journal.until_done(lambda: remove_all(folder, models_of_parts(folder, journal.state)))
    ):
        journal.record([notice])
    return journal.state
