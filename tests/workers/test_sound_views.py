"""Panoramas that are damaged after the start of a run: left out of training, scoring and evaluation."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from panolog.orchestrator.stages.evaluation import Evaluation
from panolog.scene.errors import ImageError, SceneError
from panolog.scene.images import PanoramaCache
from panolog.scene.model import Scene
from panolog.scene.ply import write_ply
from panolog.workers.evaluation import EvaluateSpec, evaluate
from panolog.workers.events import Checkpoint, Evaluated, Event, LeftOut, Preview, Scored
from panolog.workers.scoring import ScoreSpec, score
from panolog.workers.sound_views import SoundViews
from panolog.workers.specs import Value
from panolog.workers.tasks import COARSE, TaskId
from panolog.workers.training.config import TrainConfig
from panolog.workers.training.initialise import scene_gaussians
from panolog.workers.training.trainer import TrainSpec, train
from tests.workers.small import WIDTH, small_scene
from tests.workers.trainings import checkpoints, coarse_of, same, trained

CONFIG = TrainConfig.model_validate(
    {"sky": {"count": 60}, "checkpoint": {"every": 3, "share": 1}, "preview": {"every": 4}}
)
NONE = CONFIG.model_copy(update={"images": CONFIG.images.model_copy(update={"damaged": 0.0})})


def truncate(scene: Scene, row: int) -> None:
    path = scene.panoramas[row].image
    path.write_bytes(path.read_bytes()[:-30])


def spec_of(scene: Scene, config: TrainConfig = CONFIG) -> TrainSpec:
    return coarse_of(scene, config, iterations=12)


@pytest.mark.parametrize("row", range(4))
def test_training_leaves_a_damaged_panorama_out_with_one_notice(tmp_path: Path, row: int) -> None:
    scene = small_scene(tmp_path)
    truncate(scene, row)
    events = list(train(spec_of(scene)))
    (notice,) = (event for event in events if isinstance(event, LeftOut))
    assert (notice.task, notice.view) == (COARSE, f"pano_{row}.png")
    assert f"pano_{row}.png is left out: {scene.panoramas[row].image}: cannot be decoded" in notice.message
    assert all(event.view != f"pano_{row}.png" for event in events if isinstance(event, Preview))
    assert torch.isfinite(trained(events).means).all()


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


@pytest.mark.parametrize("row", range(4))
def test_a_resumed_training_leaves_the_same_out_and_ends_with_the_same_bytes(
    tmp_path: Path, row: int
) -> None:
    scene = small_scene(tmp_path)
    truncate(scene, row)
    spec = spec_of(scene)
    whole = list(train(spec))
    saved = checkpoints(whole)
    assert [event.iteration for event in saved] == [3, 6, 9]
    for checkpoint in saved:
        resumed = list(train(replace(spec, checkpoint=Value(checkpoint))))
        assert not any(isinstance(event, LeftOut) for event in resumed)  # the checkpoint knows
        assert same(trained(whole), trained(resumed))


def test_what_a_checkpoint_leaves_out_stays_left_out(tmp_path: Path) -> None:
    scene = small_scene(tmp_path)
    intact = scene.panoramas[2].image.read_bytes()
    truncate(scene, 2)
    spec = spec_of(scene)
    whole = list(train(spec))
    first = next(event for event in whole if isinstance(event, Checkpoint))
    scene.panoramas[2].image.write_bytes(intact)
    resumed = list(train(replace(spec, checkpoint=Value(first))))
    assert torch.equal(trained(whole).means, trained(resumed).means)


def test_more_than_the_limit_fails_the_task(tmp_path: Path) -> None:
    scene = small_scene(tmp_path)
    truncate(scene, 1)
    with pytest.raises(ImageError, match=r"0 of 4 panoramas may be left out: images\.damaged"):
        list(train(spec_of(scene, NONE)))
    truncate(scene, 2)
    with pytest.raises(ImageError, match=r"1 of 4 panoramas may be left out: images\.damaged"):
        list(train(spec_of(scene)))


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


def test_a_panorama_of_another_shape_is_left_out(tmp_path: Path) -> None:
    scene = small_scene(tmp_path)
    replaced = np.zeros((30, 30, 3), np.uint8)
    cv2.imwrite(str(scene.panoramas[1].image), replaced)
    (notice,) = (event for event in train(spec_of(scene)) if isinstance(event, LeftOut))
    assert "30 x 30 pixels are not 2:1" in notice.message


@pytest.mark.parametrize("damaged", [(2,), (1, 2), (1, 2, 3)])
def test_scoring_gives_damaged_panoramas_no_score(tmp_path: Path, damaged: tuple[int, ...]) -> None:
    scene = small_scene(tmp_path)
    for row in damaged:
        truncate(scene, row)
    model = scene_gaussians(scene)
    labels = np.arange(len(model), dtype=np.int64) % 2
    spec = ScoreSpec(
        task=TaskId.shard(0),
        scene=Value(scene),
        views=(1, 2, 3),
        width=WIDTH,
        model=Value(model),
        labels=Value(labels),
        blocks=2,
        config=CONFIG,
    )
    events = list(score(spec))
    left_out = [event.view for event in events if isinstance(event, LeftOut)]
    assert left_out == [f"pano_{row}.png" for row in damaged]
    scored = events[-1]
    assert isinstance(scored, Scored)
    assert scored.cameras == (1, 2, 3)
    assert [bool((row == 0).all()) for row in scored.scores] == [row in damaged for row in (1, 2, 3)]
    with pytest.raises(ImageError):
        list(score(replace(spec, config=NONE)))


def test_evaluation_measures_the_rest_and_counts_what_it_left_out(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("panolog.workers.evaluation.load_lpips", lambda _: (None, ""))
    scene = replace(small_scene(tmp_path), test=(3, 4), train=(0, 1, 2))
    model = scene_gaussians(scene)
    write_ply(tmp_path / "model.ply", model)
    truncate(scene, 3)
    spec = EvaluateSpec(scene=Value(scene), views=(3, 4), width=WIDTH, model=Value(model), near=0.01)
    report = Evaluation(scene, tmp_path / "model.ply", WIDTH, 0.0, None)
    events = list(evaluate(spec))
    for event in events:
        report.add(event)
    content = report.report()
    assert list(content["views"]) == ["pano_4.png"]
    assert list(content["left_out"]) == ["pano_3.png"]
    (measured,) = (event for event in events if isinstance(event, Evaluated))
    assert content["mean"]["psnr"] == measured.metrics["psnr"]


def test_an_evaluation_of_nothing_fails(tmp_path: Path) -> None:
    scene = small_scene(tmp_path)
    truncate(scene, 4)
    model = Value(scene_gaussians(scene))
    with pytest.raises(ImageError, match="0 of 1 panoramas may be left out"):
        list(evaluate(EvaluateSpec(scene=Value(scene), views=(4,), width=WIDTH, model=model, near=0.01)))
