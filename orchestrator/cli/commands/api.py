"""The functions of the Python API (`import panolog`) that train, evaluate and run.

Paths may be strings. All raise `panolog.InputError` or one of its subclasses for wrong input.
"""

from collections.abc import Callable, Iterator, Sequence
from os import PathLike
from pathlib import Path
from typing import Any

from panolog.orchestrator.cli.session import session
from panolog.orchestrator.engine.scheduling.pool import Pool
from panolog.orchestrator.engine.stages.scenes import divided
from panolog.orchestrator.runs.config import RunConfig
from panolog.orchestrator.runs.state import OnChange, RunState, ignore
from panolog.orchestrator.runs.units import means
from panolog.renderer.process import choose_device
from panolog.scene.files import StrPath
from panolog.scene.gaussians import Gaussians
from panolog.scene.model import Scene
from panolog.scene.ply import read_ply
from panolog.scene.read import read_scene
from panolog.workers.evaluation import EvaluateSpec
from panolog.workers.events import Checkpoint, Evaluated, Event, LeftOut, LpipsMissing
from panolog.workers.loop.views import known_rows
from panolog.workers.specs import Value
from panolog.workers.tasks import COARSE
from panolog.workers.training import trainer
from panolog.workers.training.config import TrainConfig
from panolog.workers.training.initialise import near_distance


def train(
    scene: Scene | StrPath,
    config: RunConfig | None = None,
    *,
    checkpoint: Checkpoint | None = None,
    stop: Callable[[], bool] = lambda: False,
) -> Iterator[Event]:
    """Trains one model of a whole scene (Stage I) in this process, without Ray and without a run folder.

    Yields events (`panolog.workers.events`) as they happen: Progress about once a second, Preview, Notice,
    Checkpoint. The last one is a Trained, whose `gaussians` is the model.

    Args:
        scene: the scene or its folder; training uses its training views, or all with `holdout="none"`.
        config: `iterations`, `width`, `seed`, `device` and all settings of training; the defaults if None.
        checkpoint: an earlier Checkpoint event of the same training to resume from.
        stop: checked after each iteration; once it is true, the last event is a Checkpoint.

    Raises:
        RunError: a loss is not finite, or the checkpoint belongs to another training.

    >>> import panolog
    >>> *events, trained = panolog.train(SCENE, panolog.load_config(sets=["iterations=2", "sky.count=0"]))
    >>> isinstance(trained, panolog.Trained), len(trained.gaussians)
    (True, 50)
    """
    config = config or RunConfig()
    scene = divided(_scene(scene), config)
    spec = trainer.TrainSpec(
        task=COARSE,
        scene=Value(scene),
        views=scene.train,
        width=config.width or scene.width,
        iterations=config.iterations,
        config=config,
        seed=config.seed,
        device=choose_device(config.device),
        checkpoint=Value(checkpoint) if checkpoint else None,
    )
    return trainer.train(spec, stop)


def evaluate(
    model: Gaussians | StrPath,
    scene: Scene | StrPath,
    *,
    views: Sequence[int] | None = None,
    width: int | None = None,
    near: float | None = None,
    crop_bottom: float = 0.0,
    device: str = "auto",
) -> dict[str, Any]:
    """Measures a model on panoramas of a scene.

    Args:
        model: the Gaussians or their PLY.
        scene: the scene or its folder.
        views: rows of `scene.panoramas`; the held-out ones (`scene.test`) if None.
        width: pixels to render and compare at; that of the panoramas if None.
        near: world units below which nothing is drawn; as in training with the default settings if None.
        crop_bottom: fraction of the image height, from the bottom, that is left out.
        device: "auto", "cpu" or "cuda".

    Returns:
        {"mean": metrics, "views": {name: metrics}, "lpips_reason": why LPIPS is None, or None,
        "left_out": {name: why it could not be measured}}, with the metrics psnr and ws_psnr (dB), ssim,
        ws_ssim, lpips, and lpips_3dgs of images in [0, 1].

    Raises:
        ConfigError: there are no views, or not these.

    >>> import panolog
    >>> sorted(panolog.evaluate(MODEL, SCENE, device="cpu")["mean"])[:2]
    ['cc_lpips', 'cc_psnr']
    """
    scene = _scene(scene)
    spec = EvaluateSpec(
        scene=Value(scene),
        views=known_rows(scene, scene.test if views is None else views, "views"),
        width=width or scene.width,
        model=Value(model if isinstance(model, Gaussians) else read_ply(model)),
        near=near_distance(scene, TrainConfig()) if near is None else near,
        crop_bottom=crop_bottom,
        device=choose_device(device),
    )
    measured, reason, left_out = {}, None, {}
    for event in spec.run():
        if isinstance(event, LpipsMissing):
            reason = event.message
        if isinstance(event, Evaluated):
            measured[event.view] = event.metrics
        if isinstance(event, LeftOut):
            left_out[event.view] = event.message
    mean = means(measured.values())
    return {"mean": mean, "views": measured, "lpips_reason": reason, "left_out": left_out}


def run(
    scene: Scene | StrPath | Sequence[StrPath],
    output: StrPath,
    config: RunConfig | None = None,
    *,
    address: str | None = None,
    pool: Pool | None = None,
    on_change: OnChange = ignore,
) -> RunState:
    """Reconstructs a scene into the new run folder `output`, to the end: what `panolog run` does.

    Args:
        scene: the scene or its folder; or a folder of panoramas, a 360° video, or several of these, which
            become one first, as `panolog run` does it without options.
        output: the run folder, new or empty.
        config: the settings of the run; the defaults if None.
        address: a Ray cluster as "auto" or "HOST:PORT"; this machine if None.
        pool: where tasks run instead, such as that of
            `panolog.orchestrator.engine.driver.local_pool.local_pool`, which needs no Ray.
        on_change: called with the state and the new records whenever something has happened.

    Returns:
        The state at the end; its `metrics` are the means over the held-out panoramas.

    Raises:
        RunError: the run failed. `resume` tries again.
        KeyboardInterrupt: it was interrupted. `resume` resumes it.
    """
    given = scene.root if isinstance(scene, Scene) else scene
    source = _plain(given) if isinstance(given, (str, PathLike)) else [_plain(it) for it in given]
    return session.start(source, Path(output), config or RunConfig(), address, on_change, pool)


def resume(
    run: StrPath,
    *,
    address: str | None = None,
    pool: Pool | None = None,
    on_change: OnChange = ignore,
    accept_changes: bool = False,
) -> RunState:
    """Resumes the run in a run folder from its last checkpoints, to the end; a done run is left as it is.

    Args, return value and errors are those of `run`; RunLockedError if another driver runs it, ConfigError if
    the settings in run.json were changed since it was begun, unless `accept_changes`.
    """
    return session.resume(Path(run), address, on_change, pool, accept_changes=accept_changes)


def _plain(path: StrPath) -> str | Path:
    """A path, or what may be a URL."""
    return path if isinstance(path, str) else Path(path)


def _scene(scene: Scene | StrPath) -> Scene:
    return scene if isinstance(scene, Scene) else read_scene(scene)
