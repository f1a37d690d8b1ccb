"""Panoramas that are damaged after the start of a run: left out of training, scoring and evaluation."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from panolog.scene.errors import ImageError, SceneError
from panolog.scene.images import PanoramaCache
from panolog.scene.model import Scene
from panolog.workers.events import Checkpoint, Evaluated, Event, LeftOut, Preview, Scored
from panolog.workers.sound_views import SoundViews
from panolog.workers.specs import Value
from panolog.workers.tasks import COARSE
from panolog.workers.training.config import TrainConfig
from panolog.workers.training.initialise import scene_gaussians
from panolog.workers.training.trainer import TrainSpec, train
from tests.workers.small import WIDTH, small_scene
from tests.workers.trainings import checkpoints, coarse_of, evaluation_of, same, score_of, trained

CONFIG = TrainConfig.model_validate(
    {"sky": {"count": 60}, "checkpoint": {"every": 3, "share": 1}, "preview": {"every": 4, "seconds": 1e9}}
)
NONE = CONFIG.model_copy(update={"images": CONFIG.images.model_copy(update={"damaged": 0.0})})


def truncate(scene: Scene, row: int) -> None:
    path = scene.panoramas[row].image
    path.write_bytes(path.read_bytes()[:-30])


def spec_of(scene: Scene, config: TrainConfig = CONFIG) -> TrainSpec:
    return coarse_of(scene, config, iterations=12)


@pytest.mark.parametrize("row", [0, 3])
def test_a_training_that_resumes_leaves_a_damaged_panorama_out_as_before(tmp_path: Path, row: int) -> None:
    """With one notice at the first time, and the same bytes at the end."""
    scene = small_scene(tmp_path)
    truncate(scene, row)
    spec = spec_of(scene)
    events = list(train(spec))
    (notice,) = (event for event in events if isinstance(event, LeftOut))
    assert (notice.task, notice.view) == (COARSE, f"pano_{row}.png")
    assert f"pano_{row}.png is left out: {scene.panoramas[row].image}: cannot be decoded" in notice.message
    assert all(event.view != f"pano_{row}.png" for event in events if isinstance(event, Preview))
    assert torch.isfinite(trained(events).means).all()
    saved = checkpoints(events)
    assert [event.iteration for event in saved] == [3, 6, 9]
    for checkpoint in saved:
        resumed = list(train(replace(spec, checkpoint=Value(checkpoint))))
        assert not any(isinstance(event, LeftOut) for event in resumed)  # the checkpoint knows
        assert same(trained(events), trained(resumed))


def test_a_panorama_that_is_damaged_in_the_middle_of_a_training_is_left_out_from_then_on(
    tmp_path: Path,
) -> None:
    scene = small_scene(tmp_path)
    cache = CONFIG.cache.model_copy(update={"memory": 1e-9})  # each is decoded whenever it is needed
    events = train(spec_of(scene, CONFIG.model_copy(update={"cache": cache})))
    before: list[Event] = []  # to the first checkpoint
    while not any(isinstance(event, Checkpoint) for event in before):
        before.append(next(events))
    truncate(scene, 1)
    after = list(events)
    assert not any(isinstance(event, LeftOut) for event in before)
    assert [event.view for event in after if isinstance(event, LeftOut)] == ["pano_1.png"]
    assert torch.isfinite(trained(after).means).all()


def test_more_than_the_limit_fails_the_task(tmp_path: Path) -> None:
    scene = small_scene(tmp_path)
    for row, config in enumerate((NONE, CONFIG)):
        truncate(scene, row)
        with pytest.raises(ImageError, match=rf"{row} of 4 panoramas may be left out: images\.damaged"):
            list(train(spec_of(scene, config)))


@pytest.mark.parametrize("rows, damaged, limit", [(100, 0.05, 5), (8, 0.05, 1), (1, 0.05, 0), (8, 0.0, 0)])
def test_the_limit_is_a_fraction_but_at_least_one_and_never_all(
    tmp_path: Path, rows: int, damaged: float, limit: int
) -> None:
    scene = small_scene(tmp_path)
    scene = replace(scene, panoramas=tuple(scene.panoramas[0] for _ in range(rows)))
    truncate(scene, 0)
    with PanoramaCache(scene, range(rows), WIDTH, 1) as cache:
        views = SoundViews(COARSE, scene, range(rows), cache, damaged)
        for row in range(limit):
            assert views.get(row) is None
        with pytest.raises(ImageError):
            views.get(limit)
        assert len(views.notices()) == limit


def test_a_panorama_that_cannot_be_read_is_not_left_out(tmp_path: Path) -> None:
    scene = small_scene(tmp_path)
    scene.panoramas[1].image.unlink()
    with pytest.raises(SceneError, match="cannot be read") as error:
        list(train(spec_of(scene)))
    assert not isinstance(error.value, ImageError)


@pytest.mark.parametrize("damaged", [(2,), (1, 2, 3)])
def test_scoring_gives_damaged_panoramas_no_score(tmp_path: Path, damaged: tuple[int, ...]) -> None:
    scene = small_scene(tmp_path)
    for row in damaged:
        truncate(scene, row)
    model = scene_gaussians(scene)
    spec = score_of(scene, model, (1, 2, 3), config=CONFIG)
    events = list(spec.run())
    left_out = [event.view for event in events if isinstance(event, LeftOut)]
    assert left_out == [f"pano_{row}.png" for row in damaged]
    scored = events[-1]
    assert isinstance(scored, Scored)
    assert scored.cameras == (1, 2, 3)
    assert [bool((row == 0).all()) for row in scored.scores] == [row in damaged for row in (1, 2, 3)]
    with pytest.raises(ImageError):
        list(replace(spec, config=NONE).run())


def test_evaluation_measures_the_rest(tmp_path: Path) -> None:
    scene = small_scene(tmp_path)
    truncate(scene, 3)
    spec = evaluation_of(scene, scene_gaussians(scene), (3, 4))
    views = [event.view for event in spec.run() if isinstance(event, LeftOut | Evaluated)]
    assert views == ["pano_3.png", "pano_4.png"]
    with pytest.raises(ImageError, match="0 of 1 panoramas may be left out"):
        list(replace(spec, views=(3,)).run())
