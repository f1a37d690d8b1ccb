"""What a task in training shows of itself: held-out panoramas and snapshots, which change nothing of it."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from panolog.scene.gaussians import Gaussians
from panolog.scene.images import load_view
from panolog.scene.model import Scene
from panolog.workers.events import Event, LeftOut, Preview
from panolog.workers.showing.previews import EARLY, WHOLE, PreviewClock, snapshot
from panolog.workers.specs import Value
from panolog.workers.training.optimizer import gaussians_of
from panolog.workers.training.trainer import TrainSpec, train
from tests.workers.small import HEIGHT, WIDTH, small_scene
from tests.workers.test_sound_views import truncate
from tests.workers.trainings import block_of, checkpoints, coarse_of, same, settings, trained

ROW = 4  # of the held-out panorama


@pytest.fixture(scope="module")
def shown(scene: Scene) -> TrainSpec:
    return coarse_of(scene, shown=ROW)


@pytest.fixture(scope="module")
def events(shown: TrainSpec) -> list[Event]:
    return list(train(shown))


def previews_of(events: list[Event]) -> list[Preview]:
    return [event for event in events if isinstance(event, Preview)]


def halves(preview: Preview) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The render and the photograph, (H, W, 3) RGB."""
    picture = cv2.imdecode(np.frombuffer(preview.jpeg, np.uint8), cv2.IMREAD_COLOR)
    assert picture is not None and picture.shape == (2 * HEIGHT, WIDTH, 3)
    both = picture[..., ::-1].astype(np.float64)
    return both[:HEIGHT], both[HEIGHT:]


def apart(one: NDArray[np.float64], other: NDArray[np.float64]) -> float:
    return float(np.abs(one - other).mean())


def test_a_held_out_panorama_is_shown_with_its_photograph(scene: Scene, events: list[Event]) -> None:
    photographs = [load_view(it, row, WIDTH).image.numpy() for row, it in enumerate(scene.panoramas)]
    found = previews_of(events)
    assert [event.iteration for event in found] == [1, 8, 10, 16, 24]
    for preview in found:
        assert (preview.view, preview.held_out) == (scene.panoramas[ROW].name, True)
        _, photograph = halves(preview)
        assert apart(photograph, photographs[ROW]) < 4  # JPEG
        assert min(apart(photograph, photographs[row]) for row in scene.train) > 8
    assert apart(*halves(found[-1])) < apart(*halves(found[0]))  # it is the model's picture, which learns


def test_what_is_shown_changes_nothing_of_the_model(scene: Scene, events: list[Event]) -> None:
    unseen = coarse_of(scene, settings(preview={"every": 10**6, "seconds": 1e9}))
    assert same(trained(unseen), trained(events))
    late = checkpoints(events)[-1]
    assert same(trained(replace(unseen, checkpoint=Value(late))), trained(events))


def test_a_damaged_held_out_panorama_is_none_of_the_training(tmp_path: Path, events: list[Event]) -> None:
    """A held-out panorama is not counted as left out; pictures show the first training view instead."""
    scene = small_scene(tmp_path)
    truncate(scene, ROW)
    found = list(train(coarse_of(scene, settings(images={"damaged": 0.0}), shown=ROW)))
    assert {(event.view, event.held_out) for event in previews_of(found)} == {("pano_0.png", False)}
    assert not any(isinstance(event, LeftOut) for event in found)
    assert same(trained(found), trained(events))


@pytest.mark.parametrize("kind", ["full", "baked"])
def test_a_block_shows_a_held_out_panorama_too(kind: str, shown: TrainSpec, events: list[Event]) -> None:
    task = block_of(shown, trained(events), stage2={"exterior": kind})
    if kind == "baked":
        exact = settings(stage2={"exterior": kind}, projection="exact")
        task = replace(task, config=exact)
    found = list(train(task))
    assert {(event.view, event.held_out) for event in previews_of(found)} == {("pano_4.png", True)}
    assert all(event.snapshot is None for event in previews_of(found))
    assert same(trained(found), trained(replace(task, shown=None)))


def test_a_preview_of_stage_one_has_the_model_of_its_iteration(shown: TrainSpec, events: list[Event]) -> None:
    *early, last = previews_of(events)
    assert last.snapshot is None  # the model follows
    for preview in early:
        assert preview.snapshot is not None and preview.snapshot.iteration == preview.iteration
    (tenth,) = (event.snapshot for event in early if event.iteration == 10)
    (saved,) = (checkpoint for checkpoint in checkpoints(events) if checkpoint.iteration == 10)
    assert tenth is not None
    ours, theirs = gaussians_of(tenth.tensors), gaussians_of(saved.tensors)
    assert same(ours, theirs.with_tensors(theirs.tensors() | {"shN": torch.zeros_like(theirs.shN)}))
    assert int(tenth.tensors[WHOLE]) == len(theirs) and ours.exact == theirs.exact
    size = sum(tensor.nbytes for tensor in tenth.tensors.values())
    assert size < 0.1 * sum(tensor.nbytes for tensor in saved.tensors.values())


def test_of_a_large_model_what_covers_most_is_kept_with_the_sky() -> None:
    count, sky = 12, 3
    means = torch.zeros(count, 3)
    means[:, 0] = torch.tensor([2.0, 2, 2, 2, 2, 2, 2, 40, 2, 500, 500, 500])
    scales = torch.full((count, 3), -3.0)
    scales[[1, 4]] = 0.0  # large
    scales[0], scales[7] = -2.0, -1.0  # the second one is larger, but far away
    opacities = torch.full((count,), 2.0)
    opacities[4] = -8.0  # not to be seen
    colors = torch.arange(count * 3.0).view(count, 1, 3)
    quats, rest = torch.ones(count, 4), torch.ones(count, 15, 3)
    scales[6] = torch.nan
    model = Gaussians(means, quats, scales, opacities, colors, rest, sky=sky)
    found = snapshot(model, np.zeros(3), most=3)
    kept = (found["sh0"][:, 0, 0] / 3).int().tolist()  # rows
    assert kept[:2] == [0, 1] and not {4, 6, 7} & set(kept)
    assert kept[-sky:] == [9, 10, 11] and len(kept) == 3 + sky
    assert (int(found["sky"]), int(found[WHOLE]), found["shN"].numel()) == (sky, count, 0)
    model.means[0] = 7.0
    assert float(found["means"][0, 0]) == 2.0  # a copy


def test_previews_come_early_then_by_time_and_take_little_of_it(monkeypatch: pytest.MonkeyPatch) -> None:
    now = [0.0]
    monkeypatch.setattr("time.monotonic", lambda: now[0])
    clock = PreviewClock(every=10**9, seconds=10)
    assert [iteration for iteration in range(1, 1_000) if clock.due(iteration)] == list(EARLY)
    assert PreviewClock(every=500, seconds=10).due(1_500)

    def until_due(cost: float) -> float:
        """Seconds from one that took so long to the next."""
        with clock.timed():
            now[0] += cost
        began = now[0]
        while not clock.due(7):
            now[0] += 0.5
        return now[0] - began

    assert until_due(0.01) == 10
    assert until_due(0.5) == 50  # 1 % of the time
    now[0] = 86_400.0
    assert until_due(0.01) == pytest.approx(0.05 * 86_400, abs=1)  # of days there are no thousands
