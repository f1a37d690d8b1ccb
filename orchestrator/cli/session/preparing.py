"""What a run does with panoramas or a video before it trains: poses and points, masks, depth, check.

Each step resumes where it was stopped and leaves its result in RUN/prepare: one that has a result is not
repeated. So a run that was killed at any moment ends with the scene of an undisturbed one.
"""

import json
import shutil
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter

from panolog.orchestrator.engine.driver.journal import Journal
from panolog.orchestrator.engine.driver.requests import interrupt
from panolog.orchestrator.engine.stages.outline import write_outline, write_sketch
from panolog.orchestrator.runs import control
from panolog.orchestrator.runs import info as run_info
from panolog.orchestrator.runs.config import RunConfig
from panolog.orchestrator.runs.control import Action, ControlRequest
from panolog.orchestrator.runs.folder import RunFolder, command_line
from panolog.orchestrator.runs.info import SceneRef
from panolog.orchestrator.runs.machines.machine import memory
from panolog.orchestrator.runs.preparation import notes
from panolog.orchestrator.runs.preparation.notes import Counts, StepProgress, StepResult
from panolog.orchestrator.runs.preparation.settings import (
    NADIR,
    Options,
    Settings,
    Step,
    read_settings,
    write_settings,
)
from panolog.orchestrator.runs.records import Noticed, Preparing
from panolog.orchestrator.watch.views.mask_picture import write_mask_picture
from panolog.prepare.networks.depth_maps import BATCH, plan_depth
from panolog.prepare.networks.masks import GIVEN, MaskJob, find_static, make_masks
from panolog.prepare.networks.static_regions import FEWEST
from panolog.prepare.panorama_files import PanoramaFile
from panolog.scene.errors import ConfigError, RunFolderError, SceneError
from panolog.scene.files import write_bytes
from panolog.scene.model import Scene
from panolog.scene.read import MASKS, model_folder, read_scene
from panolog.scene.stores.outline import url_of
from panolog.scene.stores.url import is_url
from panolog.workers.tasks import PREPARE

LABELS = {
    Step.SFM: "finding poses and points",
    Step.MASKS: "masking",
    Step.DEPTH: "estimating depth",
    Step.CHECK: "checking the scene",
}
_SHOWN_S = 0.5  # between two reports of progress
_POLL_S = 0.5  # between two looks for a request to stop


def with_width(most: int, config: RunConfig) -> RunConfig:
    """The settings with their width. Args: most, pixels of the panoramas. Raises ConfigError beyond it."""
    width = config.width or most
    if width > most:
        raise ConfigError(f"--width {width}: the panoramas have {most} pixels; give at most that")
    return config.model_copy(update={"width": width})


@dataclass(frozen=True)
class NewRun:
    """What a new run is of: a scene, or what one is made of."""

    config: RunConfig  # with its width
    scene: Scene | None
    settings: Settings | None

    def check_output(self, root: Path) -> None:
        """Makes sure that the run may be written to `root`; changes nothing. Raises RunFolderError."""
        if self.settings is not None:
            check_output(root, self.settings)
        elif root.is_dir() and read_settings(RunFolder(root)) is not None:
            raise RunFolderError(
                f"{root}: belongs to a run that makes its scene itself; choose another folder"
            )
        elif self.scene is not None:
            run_info.check_output(root, self.scene.fingerprint)

    def reference(self, folder: RunFolder) -> SceneRef:
        """How run.json names the scene."""
        if self.scene is None:
            return SceneRef(path=str(folder.scene.resolve()), fingerprint=run_info.PENDING)
        return reference(self.scene)


def found(source: Path | str, config: RunConfig, options: Options) -> NewRun:
    """What is at `source`. Raises InputError if nothing of that can be run."""
    remote = isinstance(source, str) and is_url(source)
    if remote and options.given:
        raise ConfigError("a URL is that of a scene; leave out the options for panoramas and videos")
    settings = None if remote else settings_of(Path(source), options)
    if settings is not None:
        return NewRun(with_width(settings.width, config), None, settings)
    scene = read_scene(source)
    return NewRun(with_width(scene.width, config), scene, None)


def reference(scene: Scene) -> SceneRef:
    """How run.json names a scene."""
    path = url_of(scene.root) or str(scene.root)
    return SceneRef(path=path, fingerprint=scene.fingerprint, offset=scene.offset)


def settings_of(source: Path, options: Options) -> Settings | None:
    """How the scene of a run of `source` is made; None if it is a scene.

    Raises InputError if it is neither a scene nor panoramas nor a video, or the options do not go with it.
    """
    if is_scene(source):
        if options.given:
            raise ConfigError(f"{source}: is a scene already; leave out the options for panoramas and videos")
        return None
    if options.depth_model is not None:
        plan_depth((), Path(options.depth_model))  # opens it: nothing of it is to be wrong hours later
    sfm, trajectory = dict(options.sfm), options.sfm.get("trajectory")
    if trajectory is not None:
        from panolog.prepare.sfm.trajectory import read_trajectory  # loading it is slow

        read_trajectory(Path(trajectory))
        sfm["trajectory"] = str(Path(trajectory).resolve())
    video, panoramas, width, masked = _look_at(source)
    return Settings(
        source=str(source.resolve()),
        video=video,
        panoramas=panoramas,
        width=width,
        sfm=sfm,
        nadir=(0.0 if masked else NADIR) if options.nadir is None else options.nadir,
        static=not masked if options.static is None else options.static,
        depth_model=options.depth_model and str(Path(options.depth_model).resolve()),
    )


def is_scene(source: Path) -> bool:
    """Whether a folder has a model. Raises SceneError if nothing is there."""
    if not source.exists() or (source.is_dir() and not any(source.iterdir())):
        what = "the folder is empty" if source.exists() else "there is no such file or folder"
        raise SceneError(f"{source}: {what}; give a scene, a folder of panoramas or a 360° video")
    try:
        model_folder(source.resolve())
    except SceneError:
        return False
    return True


def _look_at(source: Path) -> tuple[bool, int, int, bool]:
    """Whether a source is a video, how many panoramas or frames it has, their width, whether all have masks.

    Raises SceneError if it is damaged, or none of both.
    """
    from panolog.prepare.panorama_files import load_resized
    from panolog.prepare.raw_files import look_at_raw
    from panolog.prepare.sfm.pipeline import panoramas_in_folder  # loading it is slow
    from panolog.prepare.video.decode import open_video
    from panolog.scene.image_files import check_images

    if source.is_file():
        with open_video(source) as video:
            return True, video.promised, video.width, False
    if (raw := look_at_raw(source)) is not None:
        return False, *raw, False
    panoramas, layers = panoramas_in_folder(source)
    width, _ = check_images([panorama.path for panorama in panoramas])
    load_resized(panoramas[0].path, 256)  # fisheye circles, of which all are, are refused at once
    return False, len(panoramas), width, all(layers[MASKS])


def check_output(root: Path, settings: Settings) -> None:
    """Makes sure that a run with these settings may be written to `root`; changes nothing.

    A preparation that has not ended may be taken up with other settings for steps that are not done yet.
    Raises RunFolderError for anything else that is there.
    """
    folder = RunFolder(root)
    before = read_settings(folder) if root.is_dir() else None
    if before is None:
        run_info.check_output(root, run_info.PENDING)
        return
    if before.source != settings.source:
        raise RunFolderError(f"{root}: belongs to a run of {before.source}; choose another folder")
    run_info.check_unprepared(folder)
    for step in before.steps():
        result = notes.read_result(folder, step)
        done = folder.scene.exists() if step in (Step.MASKS, Step.SFM) else result is not None
        if done and (step not in settings.steps() or before.of(step) != settings.of(step)):
            raise RunFolderError(
                f"{root}: {LABELS[step]} was done with other settings; repeat them, or choose another folder"
            )


def discard(folder: RunFolder, made: list[Path]) -> None:
    """Leaves the folder of a run as it was, unless something is in it that a next driver would use."""
    work = folder.scene.with_name(f"{folder.scene.name}.sfm")
    if any(it.is_dir() and any(it.iterdir()) for it in (folder.scene, work, folder.preparation / MASKS)):
        return
    shutil.rmtree(folder.preparation, ignore_errors=True)
    run_info.discard(folder, made)


@contextmanager
def stoppable(folder: RunFolder) -> Iterator[None]:
    """While the context lasts, a request to stop the run interrupts the main thread as Ctrl-C does."""
    ended = threading.Event()

    def watch() -> None:
        while not ended.wait(_POLL_S):
            with suppress(OSError):
                wanted = [it for it in control.take(folder) if isinstance(it, ControlRequest)]
                if any(it.action == Action.STOP for it in wanted):
                    interrupt()

    watcher = threading.Thread(target=watch, daemon=True)
    watcher.start()
    try:
        yield
    finally:
        ended.set()
        watcher.join()


@dataclass
class Preparation:
    """The preparation of a run, by its driver."""

    folder: RunFolder
    settings: Settings
    journal: Journal
    _shown: float = 0.0  # time.monotonic() of the last report of progress
    _what: str = ""  # that it was about
    _lines: list[str] = field(default_factory=list)  # of the step
    _counts: Counts | None = None  # of the reconstruction

    def make(self) -> Scene:
        """Does the steps that are not done, and returns the scene.

        Raises InputError if a step cannot be done or the check finds that the scene is wrong; RunError if a
        network fails or a process is killed; KeyboardInterrupt at a request to stop.
        """
        write_settings(self.folder, self.settings)
        with stoppable(self.folder):
            steps = {Step.SFM: self._find_poses, Step.DEPTH: self._estimate_depth, Step.CHECK: self._check}
            for step, do in steps.items():  # masks are a part of the first
                if step in self.settings.steps() and notes.read_result(self.folder, step) is None:
                    with self._step(step):
                        do()
        return read_scene(self.folder.scene)

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
        self.journal.until_done(lambda: notes.write_note(notes.result_path(self.folder, step), result))
        self._lines = outer

    def _find_poses(self) -> None:
        from panolog.prepare.sfm.pipeline import (  # loading it is slow
            SfmSettings,
            make_scene,
            workspace_folder,
        )

        scene, settings = self.folder.scene, self.settings
        report = scene / "sfm.json"
        if scene.exists() and not (report.exists() and notes.sfm_picture(self.folder).exists()):
            shutil.rmtree(scene)  # its driver was killed before the report: the workspace has all for both
        if not scene.exists():
            options = TypeAdapter(SfmSettings).validate_python(settings.sfm)
            given = options, self.progress(Step.SFM), self._with_masks, memory() * 3 // 4
            made = make_scene(Path(settings.source), scene, *given, self._sketched)
            self._lines += made.lines()
        shutil.rmtree(workspace_folder(scene.resolve()), ignore_errors=True)
        for masks in (MASKS, GIVEN):  # the scene has copies
            shutil.rmtree(self.folder.preparation / masks, ignore_errors=True)
        content = json.loads(report.read_bytes())
        self._counts = counts = Counts.of(content)
        self._lines = self._lines or [f"{counts.registered} of {counts.panoramas} panoramas have a pose"]
        lines = [*self._notices(counts), *content.get("left_out", ())]
        self.journal.record([Noticed(PREPARE, line) for line in lines])
        self.journal.until_done(lambda: write_outline(self.folder, read_scene(scene), RunConfig(), anew=True))

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

    def _with_masks(
        self, panoramas: Sequence[PanoramaFile], layers: dict[str, list[Path | None]]
    ) -> dict[str, list[Path | None]]:
        """The layers with masks, which are made in RUN/prepare from those that are given."""
        if Step.MASKS not in self.settings.steps():
            return layers
        folder = self.folder.preparation
        pictures = [PanoramaFile(folder, panorama.name, panorama.path) for panorama in panoramas]
        with self._step(Step.MASKS):
            for picture, given in zip(pictures, layers.get(MASKS, []), strict=False):
                if given is not None:
                    kept = picture.layer(GIVEN)
                    kept.parent.mkdir(parents=True, exist_ok=True)
                    write_bytes(kept, given.read_bytes())
            self._mask(pictures)
            self.journal.until_done(lambda: write_mask_picture(notes.masks_picture(self.folder), pictures))
        self._note(Step.SFM, LABELS[Step.SFM])
        return layers | {MASKS: [it if (it := one.layer(MASKS)).is_file() else None for one in pictures]}

    def _mask(self, pictures: Sequence[PanoramaFile]) -> None:
        show, nadir = self.progress(Step.MASKS), self.settings.nadir or None
        static = self.settings.static and len(pictures) >= FEWEST
        if self.settings.static and not static:
            self._lines.append(f"{len(pictures)} panoramas are too few to find what is the same in all")
        region = find_static(pictures, partial(show, "static regions")) if static else None
        given = (self.folder.preparation / GIVEN).is_dir()
        if region is None and nadir is None and not given:
            return
        shares = [
            mask.ignored for mask in make_masks(pictures, MaskJob(nadir, region), partial(show, "masks"))
        ]
        parts = [f"{nadir:g}° around straight down"] if nadir else []
        parts += ["what is the same in all panoramas"] if static else []
        parts += ["the masks of the source"] if given else []
        self._lines.append(f"{sum(shares) / len(shares):.1%} of the sphere: {', '.join(parts)}")

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
            self._note(step, what, max(0, done), max(0, total))

        return show

    def _note(self, step: Step, what: str, done: int = 0, total: int = 0) -> None:
        """Shows progress, here and to other processes; a disk that takes nothing does not matter."""
        note = StepProgress(step=step, what=what, done=done, total=total, time=time.time())
        with suppress(OSError):
            notes.write_note(notes.progress_path(self.folder), note)
        self.journal.show_step(str(note))
