"""A run from its scene on: what is measured, the preflight, the driver.

It imports torch, which takes seconds: a run that begins shows its place before.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from panolog.orchestrator.cli.session.delivery import deliver
from panolog.orchestrator.engine.driver.driver import Driver, Hooks
from panolog.orchestrator.engine.driver.ending import end_recorded
from panolog.orchestrator.engine.driver.job import Job
from panolog.orchestrator.engine.driver.journal import Journal
from panolog.orchestrator.engine.driver.purse import require_enough, reserve_own
from panolog.orchestrator.engine.driver.requests import on_signals
from panolog.orchestrator.engine.driver.saving import save
from panolog.orchestrator.engine.estimates.preflight import Preflight, examine, require_memory
from panolog.orchestrator.engine.scheduling.pool import Pool
from panolog.orchestrator.engine.stages.captures import save_measured
from panolog.orchestrator.engine.stages.first_look import first_look
from panolog.orchestrator.engine.stages.measuring import measure_captures
from panolog.orchestrator.engine.stages.scenes import measured_scene
from panolog.orchestrator.runs import folder as run_folder
from panolog.orchestrator.runs import info as run_info
from panolog.orchestrator.runs.config import RunConfig
from panolog.orchestrator.runs.folder import RunFolder
from panolog.orchestrator.runs.info import RunInfo
from panolog.orchestrator.runs.money.prices import PriceList, prices_of
from panolog.orchestrator.runs.records import Noticed, Part, PreflightSaved, Preparing
from panolog.orchestrator.runs.state import ignore
from panolog.orchestrator.watch.views.plan_picture import write_plan_picture
from panolog.partition.plan import Plan
from panolog.prepare.check.layers import look_at_layers
from panolog.renderer.process import choose_device
from panolog.scene.errors import ClusterError, InputError
from panolog.scene.files import here
from panolog.scene.model import Scene
from panolog.workers.tasks import NOTHING_HELD_OUT

_FAR = "the scene is far from its origin: add {} to the coordinates of the run for the scene's"


def require(scene: Scene | None, config: RunConfig, *, local: bool) -> None:
    """Raises InputError for a device or memory with which no run is possible, before anything starts.

    Args: scene, if it is known; config with a width; local, whether the run is on this machine.
    """
    if local and config.device == "cuda":
        choose_device(config.device)
    require_memory(scene, config)


def examined(
    pool: Pool,
    scene: Scene,
    config: RunConfig,
    root: Path,
    prices: PriceList | None,
    *,
    local: bool,
    warn: Callable[[str], None] = ignore,
    say: Callable[[str], None] = ignore,
) -> Preflight:
    """The preflight of a run in the folder `root`, with the device that its machines have.

    Args: config with a width; warn, called with what the user should read; say, as `examine`.
    Raises InputError as `examine`, or if CUDA is wanted and there is none.
    """
    device = _device(config.device, pool, warn, local=local)
    return examine(pool, scene, config.model_copy(update={"device": device}), root, prices, say)


@dataclass(frozen=True)
class Driving:
    """A driver that has a scene."""

    folder: RunFolder
    journal: Journal
    scene: Scene
    local: bool  # whether its workers are on this machine

    def measure(self, info: RunInfo) -> None:
        """Measures how panoramas were captured, if Stage I is to learn that; shows the place before.

        Raises SceneError as `measure_captures`.
        """
        reserve_own(self.journal)
        self._show_points(info.config)
        measured = measure_captures(self.scene, info.config, self._does, self._warn)
        self.journal.until_done(lambda: save_measured(self.folder, measured, self.scene))

    def preflight(self, workers: Pool, info: RunInfo) -> RunConfig:
        """The resolved settings of a run, once they are in run.json. Raises InputError if it does not fit."""
        folder, journal = self.folder, self.journal
        self._does("calibrating")
        found = examined(
            workers,
            self.scene,
            info.config,
            folder.root,
            prices_of(journal.state.money.budget),
            local=self.local,
            warn=self._warn,
            say=journal.explain,
        )
        found.require()
        info = info.model_copy(update={"config": found.config})
        journal.until_done(lambda: run_folder.write_json(folder.preflight, found.as_json()))
        journal.until_done(lambda: run_info.write_info(folder, info))
        seconds = {str(stage.name): stage.seconds for stage in found.estimate.stages}
        settings = found.config.model_dump(mode="json")
        done = PreflightSaved(folder.relative(folder.preflight), seconds, settings)
        if budget := journal.state.money.budget:
            now = time.time()
            require_enough(seconds, budget, workers.nodes(), now, journal.state.money.until(now).used.cost)
        lines = [_FAR.format(self.scene.offset)] if any(self.scene.offset) else []
        in_layers = look_at_layers(self.scene)
        lines += [*in_layers.lines, *in_layers.inverted, *([] if self.scene.test else [NOTHING_HELD_OUT])]
        layers = [Noticed(None, line) for line in lines]
        journal.record([Noticed(Part.PREFLIGHT, found.summary()), *layers, done])
        return found.config

    def require_device(self, workers: Pool, config: RunConfig) -> None:
        """Raises InputError if the device that a run was begun with is not there any more."""
        _device(config.device, workers, self._warn, local=self.local)

    def drive(self, workers: Pool, config: RunConfig) -> None:
        """Runs all tasks."""
        folder = self.folder
        self._does("starting workers")

        def draw(plan: Plan, means: NDArray[np.float32]) -> None:
            folder.make(folder.plan_picture.parent)
            write_plan_picture(folder.plan_picture, plan, means)

        with on_signals() as stop, end_recorded(self.journal):
            job = Job(folder, measured_scene(folder, self.scene), config)
            Driver(job, self.journal, workers, Hooks(draw, deliver), stop).run()

    def _show_points(self, config: RunConfig) -> None:
        """The first picture of Stage I, where it is one task: the points, before anything is trained."""
        if config.districts != 1:
            return
        try:
            look = first_look(self.scene, here)
        except (InputError, OSError):
            return  # training does without that panorama, or reports it
        self.journal.record([self.journal.until_done(lambda: save(self.folder, look, self.scene))])

    def _does(self, what: str) -> None:
        self.journal.record([Preparing(what)])

    def _warn(self, line: str) -> None:
        """Something the user should read once."""
        self.journal.record([Noticed(None, line)])


def _device(wanted: str, pool: Pool, warn: Callable[[str], None], *, local: bool) -> str:
    """The device that "auto" means here. Raises InputError if CUDA is wanted and there is none."""
    if local:
        return choose_device(wanted, warn)
    gpus = any(node.gpus for node in pool.nodes()) or any(group.gpus for group in pool.growth().groups)
    if wanted == "cuda" and not gpus:
        raise ClusterError("--device cuda: no node of the cluster has a GPU; see `ray status`")
    return "cuda" if wanted != "cpu" and gpus else "cpu"
