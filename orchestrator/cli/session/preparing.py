"""What a run is given, looked at before it begins: a scene, or panoramas and videos that one is made of."""

import shutil
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from panolog.orchestrator.engine.stages.scenes import divided
from panolog.orchestrator.runs import info as run_info
from panolog.orchestrator.runs.config import RunConfig
from panolog.orchestrator.runs.folder import RunFolder
from panolog.orchestrator.runs.info import SceneRef
from panolog.orchestrator.runs.preparation import notes
from panolog.orchestrator.runs.preparation.settings import (
    LABELS,
    NADIR,
    Options,
    Settings,
    Step,
    read_settings,
)
from panolog.prepare.networks.movers import MoverNetwork
from panolog.prepare.panorama_files import PanoramaFile
from panolog.scene.errors import ConfigError, RunFolderError, SceneError
from panolog.scene.model import Scene
from panolog.scene.read import MASKS, MIN_CAMERAS, model_folder, read_scene
from panolog.scene.stores.stored_scenes import url_of
from panolog.scene.stores.url import is_url

Given = Path | str | Sequence[Path | str]  # a scene, or panoramas and videos


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


def found(source: Given, config: RunConfig, options: Options) -> NewRun:
    """What is at `source`. Raises InputError if nothing of that can be run."""
    given = [source] if isinstance(source, (str, Path)) else list(source)
    remote = [it for it in given if isinstance(it, str) and is_url(it)]
    if remote and options.given:
        raise ConfigError("a URL is that of a scene; leave out the options for panoramas and videos")
    if remote and len(given) > 1:
        raise ConfigError(f"{remote[0]}: a URL is that of a scene, which is run by itself; give it alone")
    settings = None if remote else settings_of([Path(it) for it in given], options)
    if settings is not None:
        return NewRun(with_width(settings.width, config), None, settings)
    scene = divided(read_scene(given[0]), config)
    return NewRun(with_width(scene.width, config), scene, None)


def discard(folder: RunFolder, missing: Sequence[Path]) -> None:
    """Leaves the folder of a run as it was, unless something is in it that a next driver would use.

    Args: missing, folders that were not there.
    """
    work = folder.scene.with_name(f"{folder.scene.name}.sfm")
    if any(it.is_dir() and any(it.iterdir()) for it in (folder.scene, work, folder.preparation / MASKS)):
        return
    shutil.rmtree(folder.preparation, ignore_errors=True)
    run_info.discard(folder, missing)


def reference(scene: Scene) -> SceneRef:
    """How run.json names a scene."""
    path = url_of(scene.root) or str(scene.root)
    return SceneRef(path=path, fingerprint=scene.fingerprint, offset=scene.offset)


def settings_of(source: Path | Sequence[Path], options: Options) -> Settings | None:
    """How the scene of a run of one source, or of several, is made; None if it is a scene.

    Raises InputError if one is neither a scene nor panoramas nor a video, or the options do not go with it.
    """
    sources = [source] if isinstance(source, Path) else source
    for path in sources:
        if is_scene(path):
            if options.given:
                raise ConfigError(
                    f"{path}: is a scene already; leave out the options for panoramas and videos"
                )
            if len(sources) > 1:
                raise ConfigError(f"{path}: is a scene already, which is run by itself; give it alone")
            return None
    # opens the networks, which import torch: nothing of them is to be wrong hours later
    if options.mask_model is not None:
        MoverNetwork(Path(options.mask_model))
    if options.depth_model is not None:
        from panolog.prepare.networks.depth_maps import plan_depth

        plan_depth((), Path(options.depth_model))
    sfm, trajectory = dict(options.sfm), options.sfm.get("trajectory")
    if trajectory is not None:
        from panolog.prepare.sfm.trajectory import check_times, read_trajectory  # loading it is slow
        from panolog.prepare.sources.find import find_sources

        check_times(read_trajectory(Path(trajectory)), [it.is_video for it in find_sources(sources).all])
        sfm["trajectory"] = str(Path(trajectory).resolve())
    first, *others = (str(path.resolve()) for path in sources)
    video, panoramas, width, masked = _look_at(sources)
    return Settings(
        source=first,
        others=tuple(others),
        video=video,
        panoramas=panoramas,
        width=width,
        sfm=sfm,
        nadir=(0.0 if masked else NADIR) if options.nadir is None else options.nadir,
        static=not masked if options.static is None else options.static,
        mask_model=options.mask_model and str(Path(options.mask_model).resolve()),
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


def _look_at(given: Sequence[Path]) -> tuple[bool, int, int, bool]:
    """Whether there is a video, how many panoramas and frames there are, their width, whether all have masks.

    Raises SceneError if a source is damaged, or no panoramas.
    """
    from panolog.prepare.raw_files import look_at_raw
    from panolog.prepare.sources.find import find_sources  # loading it is slow
    from panolog.prepare.sources.gather import panoramas_in_folder
    from panolog.prepare.sources.sizes import common_width
    from panolog.prepare.video.decode import open_video

    sources = find_sources(given).all
    count, masked, sizes = 0, True, list[tuple[Path, int, int]]()
    for source in sources:
        if source.is_video:
            with open_video(source.path) as video:
                count, masked = count + video.promised, False
                sizes.append((source.path, video.width, video.height))
        elif (raw := look_at_raw(source.path)) is not None:
            count, masked = count + raw[0], False
            sizes.append((source.path, raw[1], raw[1] // 2))
        else:
            panoramas = panoramas_in_folder(source.path, MIN_CAMERAS if len(sources) == 1 else 1)
            count, masked = count + len(panoramas), masked and all(MASKS in it.layers for it in panoramas)
            sizes += _sizes(panoramas)
    return any(it.is_video for it in sources), count, common_width(sizes), masked


def _sizes(panoramas: Sequence[PanoramaFile]) -> Iterator[tuple[Path, int, int]]:
    """The file, width and height of each panorama. Raises SceneError if the first shows fisheye circles."""
    from panolog.prepare.panorama_files import load_resized
    from panolog.prepare.sources.convert import displayed_size, is_converted
    from panolog.prepare.world.cropped import whole_size
    from panolog.scene.image_files import read_info

    first = None if is_converted(panoramas[0].path) else read_info(panoramas[0].path)
    if first is not None and first.width == 2 * first.height:
        load_resized(panoramas[0].path, 256)  # as all show them, they are refused at once
    for panorama in panoramas:
        size = displayed_size if is_converted(panorama.path) else whole_size
        yield panorama.path, *size(panorama.path)


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
    if sorted(before.sources) != sorted(settings.sources):
        raise RunFolderError(
            f"{root}: belongs to a run of {', '.join(before.sources)}; choose another folder"
        )
    run_info.check_unprepared(folder)
    for step in before.steps():
        result = notes.read_result(folder, step)
        done = folder.scene.exists() if step in (Step.MASKS, Step.SFM) else result is not None
        if done and (step not in settings.steps() or before.of(step) != settings.of(step)):
            raise RunFolderError(
                f"{root}: {LABELS[step]} was done with other settings; repeat them, or choose another folder"
            )
