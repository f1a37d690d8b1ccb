"""What a run does with panoramas or a video before it trains: poses and points, masks, depth, check.

Each step resumes where it was stopped and leaves its result in RUN/prepare: one that has a result is not
repeated. So a run that was killed at any moment ends with the scene of an undisturbed one.
"""

import json
import shutil
import time
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, suppress
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter

from panolog.orchestrator.engine.driver.journal import Journal
from panolog.orchestrator.engine.driver.purse import require_left, reserve_own
from panolog.orchestrator.engine.driver.requests import interrupt
from panolog.orchestrator.engine.stages.outline import write_outline, write_sketch
from panolog.orchestrator.engine.stages.scenes import divided
from panolog.orchestrator.runs import control
from panolog.orchestrator.runs.clock import repeated
from panolog.orchestrator.runs.config import RunConfig
from panolog.orchestrator.runs.control import Action, ControlRequest
from panolog.orchestrator.runs.folder import RunFolder, command_line
from panolog.orchestrator.runs.machines.machine import memory_of_preparation
from panolog.orchestrator.runs.preparation import notes
from panolog.orchestrator.runs.preparation.notes import Counts, StepProgress, StepResult
from panolog.orchestrator.runs.preparation.settings import LABELS, Settings, Step, write_settings
from panolog.orchestrator.runs.records import Noticed, Preparing
from panolog.orchestrator.watch.views.mask_picture import write_mask_picture
from panolog.prepare.networks.depth_maps import BATCH
from panolog.prepare.networks.masks import GIVEN, MaskJob, find_static, make_masks
from panolog.prepare.networks.movers import MoverNetwork
from panolog.prepare.networks.static_regions import FEWEST, StaticRegion
from panolog.prepare.panorama_files import PanoramaFile
from panolog.scene.errors import SceneError
from panolog.scene.files import write_bytes
from panolog.scene.model import Scene
from panolog.scene.read import MASKS, read_scene
from panolog.scene.write import part_of
from panolog.workers.tasks import PREPARE

_SHOWN_S = 0.5  # between two reports of progress
_POLL_S = 0.5  # between two looks for a request to stop


def stoppable(folder: RunFolder) -> AbstractContextManager[None]:
    """While the context lasts, a request to stop the run interrupts the main thread as Ctrl-C does."""

    def look() -> None:
        with suppress(OSError):
            wanted = [it for it in control.take(folder) if isinstance(it, ControlRequest)]
            if any(it.action == Action.STOP for it in wanted):
                interrupt()

    return repeated(look, _POLL_S)


@dataclass
class Preparation:
    """The preparation of a run, by its driver."""

    folder: RunFolder
    settings: Settings
    config: RunConfig
    journal: Journal
    _shown: float = 0.0  # time.monotonic() of the last report of progress
    _what: str = ""  # that it was about
    _panoramas: int = 0  # of which features are found, once that is known
    _lines: list[str] = field(default_factory=list)  # of the step
    _counts: Counts | None = None  # of the reconstruction

    def make(self) -> Scene:
        """Does the steps that are not done, and returns the scene.

        Raises InputError if a step cannot be done, the check finds that the scene is wrong, or a limit is
        reached; RunError if a network fails or a process is killed; KeyboardInterrupt at a request to stop.
        """
        reserve_own(self.journal)
        write_settings(self.folder, self.settings)
        with stoppable(self.folder):
            steps = {Step.SFM: self._find_poses, Step.DEPTH: self._estimate_depth, Step.CHECK: self._check}
            for step, do in steps.items():  # masks are a part of the first
                if step in self.settings.steps() and notes.read_result(self.folder, step) is None:
                    with self._step(step):
                        do()
        return divided(read_scene(self.folder.scene), self.config)

    @contextmanager
    def _step(self, step: Step) -> Iterator[None]:
        """A step, or a part of another, from its first progress to its result."""
        self.journal.record([Preparing(LABELS[step], PREPARE)])
        self._note(step, LABELS[step])
        outer, self._lines, self._counts = self._lines, [], None
        began = time.monotonic()
        yield
        result = StepResult(
            step=step,
            settings=self.settings.of(step),
            seconds=time.monotonic() - began,
            lines=notes.shortened(self._lines),
            counts=self._counts,
        )
        self.journal.until_done(lambda: notes.write_note(self.folder.step_result(step), result))
        self._lines = outer

    def _find_poses(self) -> None:
        from panolog.prepare.sfm.pipeline import (  # loading it is slow
            SfmSettings,
            make_scene,
            workspace_folder,
        )

        scene, settings = self.folder.scene, self.settings
        report = scene / "sfm.json"
        if scene.exists() and not (report.exists() and self.folder.sfm_picture.exists()):
            shutil.rmtree(scene)  # its driver was killed before the report: the workspace has all for both
        if not scene.exists():
            options = TypeAdapter(SfmSettings).validate_python(settings.sfm)
            paths = [Path(source) for source in settings.sources]
            source = paths if len(paths) > 1 else paths[0]
            given = options, self.progress(Step.SFM), self._with_masks, memory_of_preparation()
            made = make_scene(source, scene, *given, self._sketched)
            self._lines += made.lines()
        shutil.rmtree(workspace_folder(scene.resolve()), ignore_errors=True)
        for masks in (MASKS, GIVEN):  # the scene has copies
            shutil.rmtree(self.folder.preparation / masks, ignore_errors=True)
        content = json.loads(report.read_bytes())
        self._counts = counts = Counts.of(content)
        self._lines = self._lines or [f"{counts.registered} of {counts.panoramas} panoramas have a pose"]
        lines = [*self._notices(counts), *content.get("left_out", ())]
        self.journal.record([Noticed(PREPARE, line) for line in lines])
        self.journal.until_done(
            lambda: write_outline(
                self.folder, divided(read_scene(scene), self.config), self.config, anew=True
            )
        )

    def _sketched(self, sketch: Any) -> None:
        """Shows what is known of the place; a disk that takes nothing does not matter."""
        with suppress(OSError):
            write_sketch(self.folder, **vars(sketch))

    def _notices(self, counts: Counts) -> Iterator[str]:
        """What the user should read of the reconstruction."""
        yield self._lines[0]
        doubts = {
            "without a pose": counts.panoramas - counts.registered,
            "weak links": counts.weak_links,
            "contradictions": counts.contradictions,
        }
        if found := [f"{what}: {number:,}" for what, number in doubts.items() if number]:
            yield f"{', '.join(found)}; {self.folder.scene / 'sfm.json'} names them"

    def _with_masks(self, panoramas: Sequence[PanoramaFile]) -> Sequence[PanoramaFile]:
        """The panoramas with masks, which are made in RUN/prepare from those that are given."""
        if Step.MASKS not in self.settings.steps():
            return panoramas
        folder = self.folder.preparation
        pictures = [replace(panorama, root=folder) for panorama in panoramas]
        with self._step(Step.MASKS):
            shutil.rmtree(folder / GIVEN, ignore_errors=True)  # the source may have fewer than it had
            for picture in pictures:
                if (given := picture.layers.get(MASKS)) is not None:
                    kept = picture.layer(GIVEN)
                    self.folder.make(kept.parent)
                    write_bytes(kept, given.read_bytes())
            self._mask(pictures)
            self.journal.until_done(lambda: write_mask_picture(self.folder.masks_picture, pictures))
        self._note(Step.SFM, LABELS[Step.SFM])
        made = [{MASKS: it} if (it := picture.layer(MASKS)).is_file() else {} for picture in pictures]
        return [replace(one, layers={**one.layers, **own}) for one, own in zip(panoramas, made, strict=True)]

    def _mask(self, pictures: Sequence[PanoramaFile]) -> None:
        """Masks the panoramas of each source by what is the same in it: cameras have their own operators."""
        nadir, given = self.settings.nadir or None, (self.folder.preparation / GIVEN).is_dir()
        model = self.settings.mask_model
        movers = MoverNetwork(Path(model)) if model else None
        of_source = {it.source: [one for one in pictures if one.source == it.source] for it in pictures}
        regions = self._static(of_source)
        if not (regions or nadir or given or movers):
            return
        shares = list[float]()
        for turn, (label, own) in enumerate(of_source.items()):
            show = part_of(partial(self.progress(Step.MASKS), "masks"), turn, len(of_source))
            job = MaskJob(nadir, regions.get(label), movers)
            shares += [mask.ignored for mask in make_masks(own, job, show)]
        parts = [f"{nadir:g}° around straight down"] if nadir else []
        parts += (
            ["what is the same in all panoramas" + " of a source" * (len(of_source) > 1)] if regions else []
        )
        parts += [f"what {Path(model).name} finds"] if model else []
        parts += ["the masks of the source"] if given else []
        self._lines.append(f"{sum(shares) / len(shares):.1%} of the sphere: {', '.join(parts)}")

    def _static(self, of_source: dict[str, list[PanoramaFile]]) -> dict[str, StaticRegion]:
        """What is the same in the panoramas of each source, where that is wanted and they are enough."""
        regions = dict[str, StaticRegion]()
        for turn, (label, own) in enumerate(of_source.items() if self.settings.static else ()):
            if len(own) < FEWEST:
                of = f"{label}: " if label else ""
                self._lines.append(f"{of}{len(own)} panoramas are too few to find what is the same in all")
                continue
            show = part_of(partial(self.progress(Step.MASKS), "static regions"), turn, len(of_source))
            regions[label] = find_static(own, show)
        return regions

    def _estimate_depth(self) -> None:
        from panolog.prepare.networks.depth_report import estimate_depth

        model = Path(self.settings.depth_model or "")
        report = estimate_depth(
            self.folder.scene,
            model,
            batch=BATCH,
            device="auto",
            say=self._lines.append,
            progress=self.progress(Step.DEPTH),
        )
        self._lines += report.lines()

    def _check(self) -> None:
        from panolog.prepare.check.scene_check import check_scene

        scene = self.folder.scene
        found = check_scene(read_scene(scene))
        self._lines += found.lines()
        if found.problems:
            more = f" (and {len(found.problems) - 1} more)" if len(found.problems) > 1 else ""
            raise SceneError(
                f"{scene}: {found.problems[0]}{more}; `{command_line('scene', 'check', scene)}` says more;"
                f" `{command_line('run', scene, '-o', 'OTHER')}` trains on it as it is"
            )

    def progress(self, step: Step) -> Any:
        """The `StageProgress` of a step."""

        def show(what: str, done: int, total: int) -> None:
            now = time.monotonic()
            if what == self._what and now - self._shown < _SHOWN_S and done != total:
                return
            self._shown, self._what = now, what
            require_left(self.journal.state, time.time())
            if what == "features":
                self._panoramas = total
            self._note(step, what, max(0, done), max(0, total))

        return show

    def _note(self, step: Step, what: str, done: int = 0, total: int = 0) -> None:
        """Shows progress, here and to other processes; a disk that takes nothing does not matter."""
        now, count = time.time(), self._panoramas
        note = StepProgress(step=step, what=what, done=done, total=total, time=now, panoramas=count)
        with suppress(OSError):
            notes.write_note(self.folder.preparation_progress, note)
        self.journal.show_step(str(note))
