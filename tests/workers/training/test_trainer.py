"""Training end to end on a scene of five tiny panoramas."""

import pickle
from collections.abc import Iterator
from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch
from torch import Tensor

from panolog.partition.bounds import aabb
from panolog.partition.cells import Cell, Grid
from panolog.renderer.render import render
from panolog.scene.errors import RunError
from panolog.scene.gaussians import Gaussians, logit
from panolog.scene.images import PanoramaCache
from panolog.scene.model import Scene
from panolog.workers.events import Checkpoint, Event, Notice, Preview, Progress, Trained
from panolog.workers.sound_views import open_cache
from panolog.workers.specs import Value
from panolog.workers.tasks import COARSE, TaskId
from panolog.workers.training import direct
from panolog.workers.training.config import PyramidConfig, TrainConfig
from panolog.workers.training.exterior import inside
from panolog.workers.training.trainer import Trainer, TrainSpec, train
from tests.on_device import ToDevice
from tests.workers.small import WIDTH, small_scene

CONFIG = TrainConfig.model_validate(
    {
        "sky": {"count": 60},
        "densify": {"every_floor": 4, "start": 0, "gradient": 1e-6, "max_gaussians": 260},
        "reset": {"every_floor": 9, "opacity": 0.05},
        "sh": {"every": 6000},
        "checkpoint": {"every": 5, "share": 1},
        "preview": {"every": 8},
    }
)


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    return small_scene(tmp_path_factory.mktemp("scene"))


@pytest.fixture(scope="module")
def coarse(scene: Scene) -> TrainSpec:
    return spec_of(COARSE, scene, scene.train)


@pytest.fixture(scope="module")
def events(coarse: TrainSpec) -> list[Event]:
    """Those of the whole coarse training, to read only."""
    return list(train(coarse))


def spec_of(task: TaskId, scene: Scene, views: tuple[int, ...]) -> TrainSpec:
    return TrainSpec(
        task=task, scene=Value(scene), views=views, width=WIDTH, iterations=24, config=CONFIG, seed=3
    )


def block_of(scene: Scene, initial: Gaussians) -> TrainSpec:
    cell = Cell(aabb(scene.centers, 5.0), Grid((2, 1, 1)), 1)
    return replace(spec_of(TaskId.block(1), scene, (0, 2)), initial=Value(initial), cell=cell)


def trained(events: list[Event]) -> Gaussians:
    last = events[-1]
    assert isinstance(last, Trained)
    return last.gaussians


def same(a: Gaussians, b: Gaussians) -> bool:
    pairs = zip(a.tensors().values(), b.tensors().values(), strict=True)
    return a.sky == b.sky and all(x.numpy().tobytes() == y.numpy().tobytes() for x, y in pairs)


def sky_of(gaussians: Gaussians) -> dict[str, Tensor]:
    return {name: tensor[gaussians.scene.stop :] for name, tensor in gaussians.tensors().items()}


def progress_of(events: list[Event]) -> list[Progress]:
    return [event for event in events if isinstance(event, Progress)]


def checkpoints(events: list[Event]) -> Iterator[Checkpoint]:
    return (event for event in events if isinstance(event, Checkpoint))


def test_stage_one_learns(coarse: TrainSpec) -> None:
    calm = CONFIG.model_copy(update={"reset": CONFIG.reset.model_copy(update={"quiet": 1.0})})
    before, *_ = progress_of(list(train(replace(coarse, iterations=1))))
    *_, after = progress_of(list(train(replace(coarse, iterations=150, config=calm))))
    assert before.psnr is not None and after.psnr is not None and after.psnr > before.psnr + 2


def test_stage_one_reports_its_events(events: list[Event]) -> None:
    progress = progress_of(events)
    assert progress[-1].iteration == progress[-1].iterations == 24
    assert progress[-1].gaussians == len(trained(events)) and progress[-1].rates["sh0"] == 2.5e-3
    previews = [event for event in events if isinstance(event, Preview)]
    assert [event.iteration for event in previews] == [8, 16, 24]
    assert previews[0].view == "pano_0.png" and previews[0].jpeg[:2] == b"\xff\xd8"
    assert [event.iteration for event in checkpoints(events)] == [5, 10, 15, 20]
    assert not [event for event in events if isinstance(event, Notice)]


def test_resume_equals_undisturbed_byte_for_byte(coarse: TrainSpec, events: list[Event]) -> None:
    for checkpoint in checkpoints(events):
        sent = pickle.loads(pickle.dumps(checkpoint))
        again = list(train(replace(pickle.loads(pickle.dumps(coarse)), checkpoint=Value(sent))))
        assert same(trained(again), trained(events)), checkpoint.iteration


def test_resume_of_a_pyramid_equals_undisturbed_byte_for_byte(coarse: TrainSpec) -> None:
    """Also where one checkpoint is before a step of the width, and one is after it."""
    config = CONFIG.model_copy(update={"pyramid": PyramidConfig(steps=(0.3, 0.7))})
    pyramid = replace(coarse, config=config)
    events = list(train(pyramid))
    pictures = [np.frombuffer(e.jpeg, np.uint8) for e in events if isinstance(e, Preview)]
    widths = [cv2.imdecode(picture, cv2.IMREAD_COLOR).shape[1] for picture in pictures]  # type: ignore[union-attr]
    assert widths == [WIDTH // 2, WIDTH // 2, WIDTH]
    for checkpoint in checkpoints(events):
        again = list(train(replace(pyramid, checkpoint=Value(checkpoint))))
        assert same(trained(again), trained(events)), checkpoint.iteration


def test_a_checkpoint_does_not_change_while_training_continues(coarse: TrainSpec) -> None:
    stream = train(coarse)
    first = next(event for event in stream if isinstance(event, Checkpoint))
    before = {name: tensor.clone() for name, tensor in first.tensors.items()}
    list(stream)
    assert all(torch.equal(first.tensors[name], tensor) for name, tensor in before.items())


def test_the_number_of_threads_does_not_matter(coarse: TrainSpec) -> None:
    threads = torch.get_num_threads()
    try:
        torch.set_num_threads(1)
        one = trained(list(train(coarse)))
        torch.set_num_threads(3)
        three = trained(list(train(coarse)))
    finally:
        torch.set_num_threads(threads)
    assert same(one, three)


def test_the_seed_matters(coarse: TrainSpec, events: list[Event]) -> None:
    assert not same(trained(events), trained(list(train(replace(coarse, seed=4)))))


def test_sky_neither_moves_nor_multiplies_in_stage_one_but_learns(
    coarse: TrainSpec, events: list[Event]
) -> None:
    start = trained(list(train(replace(coarse, iterations=1))))
    end = trained(events)
    assert start.sky == end.sky == 60 and len(end) > 200
    first, last = sky_of(start), sky_of(end)
    assert torch.equal(first["means"], last["means"]) and torch.equal(first["scales"], last["scales"])
    assert not torch.equal(first["sh0"], last["sh0"])
    assert (last["opacities"].sigmoid() > 0.2).all()  # no reset


def test_the_sky_trains_its_scales_where_that_is_set(coarse: TrainSpec, events: list[Event]) -> None:
    config = CONFIG.model_copy(update={"sky": CONFIG.sky.model_copy(update={"train_scales": True})})
    other = trained(list(train(replace(coarse, config=config))))
    assert not torch.equal(sky_of(other)["scales"], sky_of(trained(events))["scales"])


def test_what_never_rose_after_the_last_reset_is_no_haze(
    coarse: TrainSpec, events: list[Event], scene: Scene
) -> None:
    *_, late = (replace(c, tensors=dict(c.tensors)) for c in checkpoints(events))  # after the last reset
    late.tensors["opacities"] = late.tensors["opacities"].clone()
    late.tensors["opacities"][:40] = logit(0.003)  # below 1/255: no view draws it, none gives it a gradient
    ceiling = CONFIG.reset.opacity
    whole = trained(list(train(replace(coarse, checkpoint=Value(late)))))
    assert whole.sky == 60 and (whole.opacities[whole.scene].sigmoid() > ceiling).all()
    block = trained(list(train(block_of(scene, trained(events)))))
    assert len(block) > 0 and (block.opacities.sigmoid() > ceiling).all()


def test_without_sky(coarse: TrainSpec) -> None:
    config = CONFIG.model_copy(update={"sky": CONFIG.sky.model_copy(update={"count": 0})})
    assert trained(list(train(replace(coarse, config=config)))).sky == 0


def test_a_block_keeps_only_its_cell_and_leaves_the_sky_alone(events: list[Event], scene: Scene) -> None:
    initial = trained(events)
    task = block_of(scene, initial)
    events = list(train(task))
    assert task.cell is not None
    block = trained(events)
    assert block.sky == 0 and 0 < len(block) < len(initial)
    assert task.cell.contains(block.means.numpy()).all()
    assert (block.opacities.sigmoid() > 0.005).all()
    *_, final = checkpoints(events)
    for name, tensor in sky_of(initial).items():
        assert final.tensors[name][-60:].numpy().tobytes() == tensor.numpy().tobytes(), name
    for checkpoint in checkpoints(events):
        assert same(trained(list(train(replace(task, checkpoint=Value(checkpoint))))), block)


@pytest.mark.parametrize("method", ["clone-split", "relocate"])
def test_what_is_outside_of_a_block_stays_where_that_is_set(
    events: list[Event], scene: Scene, method: str
) -> None:
    initial = trained(events)
    task = block_of(scene, initial)
    assert task.cell is not None
    config = task.config.model_dump() | {"stage2": {"exterior": "frozen"}}
    config["densify"]["method"] = method
    task = replace(task, config=TrainConfig.model_validate(config))
    assert task.cell is not None
    outside = ~task.cell.contains(initial.means.numpy())
    outside[initial.scene.stop :] = True
    last = list(train(task))
    *_, final = checkpoints(last)
    for name, tensor in initial.tensors().items():
        found, kept = final.tensors[name][-outside.sum() :], tensor[torch.from_numpy(outside)]
        assert found.numpy().tobytes() == kept.numpy().tobytes(), name
    block = trained(last)
    assert block.sky == 0 and len(block) and task.cell.contains(block.means.numpy()).all()
    for checkpoint in checkpoints(last):
        assert same(trained(list(train(replace(task, checkpoint=Value(checkpoint))))), block)


@pytest.mark.parametrize(("reset", "inner", "outer"), [("all", 0, 0), ("cell", 0, 1), ("none", 1, 1)])
def test_resets_may_spare_what_is_outside_of_a_block(
    events: list[Event], scene: Scene, reset: str, inner: bool, outer: bool
) -> None:
    initial = trained(events)
    task = block_of(scene, replace(initial, opacities=torch.full_like(initial.opacities, 3.0)))
    config = task.config.model_dump() | {"stage2": {"reset": reset}}
    config["densify"] |= {"until": 30_000, "gradient": 1e3}
    task = replace(task, config=TrainConfig.model_validate(config))
    with open_cache(task, scene, task.views, 1 << 30, 0) as cache:
        trainer = Trainer(task, scene, cache)
        trainer.begin()
        list(trainer.run(lambda: trainer.iteration == 9))
    gaussians = trainer.state.gaussians
    high = (gaussians.opacities[gaussians.scene] > logit(0.05)).numpy()
    within = inside(gaussians, task.cell)
    assert high[within].any() == inner and high[~within].any() == outer


def test_a_block_starts_from_the_full_model_without_changing_it(coarse: TrainSpec, scene: Scene) -> None:
    initial = trained(list(train(replace(coarse, iterations=2))))
    before = {name: tensor.clone() for name, tensor in initial.tensors().items()}
    list(train(block_of(scene, initial)))
    assert all(torch.equal(tensor, before[name]) for name, tensor in initial.tensors().items())


def test_what_is_not_finite_ends_the_run_with_a_name(
    coarse: TrainSpec, monkeypatch: pytest.MonkeyPatch
) -> None:
    def poisoned(gaussians: Gaussians, *args: object, **options: object) -> object:
        rendered = render(gaussians, *args, **options)  # type: ignore[arg-type]
        return rendered._replace(color=rendered.color * float("nan"))

    monkeypatch.setattr(direct, "render", poisoned)
    with pytest.raises(RunError, match=r"coarse: the loss is not finite at iteration 1, view pano_\d\.png"):
        list(train(coarse))


def test_invalid_gaussians_are_removed_with_a_notice(coarse: TrainSpec) -> None:
    first = next(event for event in train(coarse) if isinstance(event, Checkpoint))
    first.tensors["means"][7, 0] = float("nan")
    events = list(train(replace(coarse, checkpoint=Value(first))))
    notices = [event.message for event in events if isinstance(event, Notice)]
    assert len(notices) == 1 and notices[0].startswith("1 Gaussians were not finite at iteration 8")
    assert all(torch.isfinite(tensor).all() for tensor in trained(events).tensors().values())


def test_images_left_out_of_the_depth_loss_are_named(coarse: TrainSpec) -> None:
    scene = coarse.scene.load()
    panoramas = tuple(replace(panorama, observed=panorama.observed[:5]) for panorama in scene.panoramas)
    events = train(replace(coarse, scene=Value(replace(scene, panoramas=panoramas)), iterations=8))
    notices = sorted(event.message for event in events if isinstance(event, Notice))
    assert [notice.split(" ")[0] for notice in notices] == [f"pano_{i}.png" for i in range(4)]


def test_depth_supervision_changes_the_result(coarse: TrainSpec, events: list[Event]) -> None:
    config = CONFIG.model_copy(update={"depth": CONFIG.depth.model_copy(update={"w0": 0.0})})
    assert not same(trained(events), trained(list(train(replace(coarse, config=config)))))


def test_the_unit_of_length_does_not_matter(coarse: TrainSpec, scene: Scene) -> None:
    kilo = 1000.0
    poses = tuple(replace(p, translation=p.translation * kilo) for p in scene.panoramas)
    larger = replace(scene, panoramas=poses, points=scene.points * kilo)
    found = [
        list(train(replace(coarse, scene=Value(other), iterations=4)))  # the last one densifies
        for other in (scene, larger)
    ]
    (*_, first), (*_, second) = map(progress_of, found)
    assert first.loss is not None and second.loss == pytest.approx(first.loss, rel=1e-4)
    assert first.gaussians == second.gaussians
    one, other = map(trained, found)
    assert torch.allclose(one.means * kilo, other.means, atol=1e-2 * kilo)
    assert torch.allclose(one.opacities, other.opacities, atol=1e-3)


def test_a_checkpoint_of_another_task_is_refused(coarse: TrainSpec) -> None:
    with pytest.raises(RunError, match="does not continue coarse"):
        next(train(replace(coarse, checkpoint=Value(Checkpoint(TaskId.block(0), 5, {})))))


def test_half_a_block_is_no_task(coarse: TrainSpec) -> None:
    with pytest.raises(ValueError, match="needs both"):
        replace(coarse, cell=Cell(aabb(coarse.scene.load().centers, 5.0), Grid((1, 1, 1)), 0))


def test_nothing_trains_without_views(coarse: TrainSpec, scene: Scene) -> None:
    initial = trained(list(train(replace(coarse, iterations=1))))
    for task in (coarse, block_of(scene, initial)):
        with pytest.raises(ValueError, match="no views"):
            replace(task, views=())


def test_a_preview_shows_a_view_that_is_on_a_device(coarse: TrainSpec, events: list[Event]) -> None:
    scene = coarse.scene.load()
    with PanoramaCache(scene, coarse.views, WIDTH, 1, device="cuda", upload=ToDevice()) as cache:
        trainer = Trainer(coarse, scene, cache)
        trainer.begin()
        shown = trainer._preview()
    with PanoramaCache(scene, coarse.views, WIDTH, 1) as cache:
        trainer = Trainer(coarse, scene, cache)
        trainer.begin()
        assert trainer._preview() == shown


def test_splitting_by_distance_resumes_with_the_same_bytes(coarse: TrainSpec, events: list[Event]) -> None:
    densify = CONFIG.densify.model_copy(update={"large": "distance", "percent_dense": 0.2})
    task = replace(coarse, config=CONFIG.model_copy(update={"densify": densify}))
    found = list(train(task))
    assert not same(trained(found), trained(events))
    *_, late = checkpoints(found)
    first, *_ = checkpoints(found)
    for checkpoint in (first, late):
        assert same(trained(list(train(replace(task, checkpoint=Value(checkpoint))))), trained(found))
