"""A block that has become worse for the panoramas of other blocks leaves its cell as Stage I has it."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from panolog.renderer.render import render_bytes
from panolog.scene.gaussians import Gaussians
from panolog.scene.images import load_view
from panolog.scene.model import Scene
from panolog.scene.ply import write_ply
from panolog.workers.comparison import squared_error, with_block
from panolog.workers.events import Checkpoint, LeftOut, Trained
from panolog.workers.merge import retained
from panolog.workers.metrics import decibel, measure
from panolog.workers.specs import ModelFile, Value
from panolog.workers.training.config import TrainConfig
from panolog.workers.training.trainer import TrainSpec, train
from tests.workers.small import WIDTH, small_scene
from tests.workers.trainings import block_of, bytes_of, coarse_of, notices, stop_at, trained

pytestmark = pytest.mark.system

CONFIG = TrainConfig.model_validate(
    {"sky": {"count": 60}, "checkpoint": {"every": 5, "share": 1}, "preview": {"every": 50, "seconds": 1e9}}
)


@pytest.fixture
def scene(tmp_path: Path) -> Scene:
    return small_scene(tmp_path)


@pytest.fixture
def block(scene: Scene) -> TrainSpec:
    """A block of the cameras 0 and 2 that improves a model of three iterations, for 1 and 3 too."""
    coarse, path = coarse_of(scene, CONFIG, iterations=3), scene.root / "coarse.ply"
    model = trained(coarse)
    write_ply(path, model)
    return replace(block_of(coarse, model), initial=ModelFile(path), compared=(3, 1), iterations=10)


@pytest.fixture
def misled(block: TrainSpec) -> TrainSpec:
    """The same where the block's own panoramas show something else than all others."""
    scene = block.scene.load()
    for row in block.views:
        path = str(scene.panoramas[row].image)
        cv2.imwrite(path, 255 - np.asarray(cv2.imread(path)))
    return block


def before(spec: TrainSpec) -> Gaussians:
    assert spec.initial is not None
    return spec.initial.load()


def kept(spec: TrainSpec) -> Gaussians:
    """What the merge takes for a block that is not trained."""
    assert spec.cell is not None
    return retained(before(spec), spec.cell, 0.0)


def test_a_block_that_is_better_elsewhere_stays(block: TrainSpec) -> None:
    alone, compared = (list(train(replace(block, compared=rows))) for rows in ((), block.compared))
    assert bytes_of(trained(compared)) == bytes_of(trained(alone))
    assert bytes_of(trained(compared)) != bytes_of(kept(block)) and not notices(compared)


def test_a_block_that_is_worse_elsewhere_leaves_its_cell_as_it_was(misled: TrainSpec) -> None:
    events = list(train(misled))
    assert bytes_of(trained(events)) == bytes_of(kept(misled))
    (notice,) = notices(events)
    start = "keeps what it started from: on 2 panoramas that see its part of the place that has "
    assert notice.startswith(start)
    better, worse = (float(text.split()[-1]) for text in (notice.split(" dB")[0], notice.split(" (WS")[0]))
    assert worse < better
    for rows in ((), misled.views):  # on its own panoramas it would stay
        own = list(train(replace(misled, compared=rows)))
        assert not notices(own) and bytes_of(trained(own)) != bytes_of(kept(misled))


@pytest.mark.parametrize("renders", [0, 3])
def test_a_stop_during_the_comparison_leaves_a_checkpoint(misled: TrainSpec, renders: int) -> None:
    stopped = list(train(misled, stop_at(misled.iterations + renders)))  # one call for each iteration
    last = stopped[-1]
    assert isinstance(last, Checkpoint) and last.iteration == misled.iterations
    assert not notices(stopped) and not any(isinstance(event, Trained) for event in stopped)
    again = list(train(replace(misled, checkpoint=Value(last))))
    assert bytes_of(trained(again)) == bytes_of(kept(misled)) and len(notices(again)) == 1


def test_damaged_panoramas_are_left_out_of_the_comparison(misled: TrainSpec) -> None:
    scene = misled.scene.load()
    for count, row in enumerate(misled.compared, 1):
        path = scene.panoramas[row].image
        path.write_bytes(path.read_bytes()[:-30])
        events = list(train(misled))
        left_out = [event.view for event in events if isinstance(event, LeftOut)]
        assert sorted(left_out) == sorted(f"pano_{row}.png" for row in misled.compared[:count])
        assert ["on 1 panoramas" in text for text in notices(events)] == [True] * (2 - count)
    assert bytes_of(trained(events)) == bytes_of(trained(list(train(replace(misled, compared=())))))


def test_the_error_is_that_of_ws_psnr(block: TrainSpec) -> None:
    scene, model = block.scene.load(), before(block)
    for row in scene.train:
        panorama, view = scene.panoramas[row], load_view(scene.panoramas[row], row, WIDTH)
        assert view.mask is not None and not view.mask.all()
        error, area = squared_error(model, panorama, view, 0.01)
        image = render_bytes(model, panorama.rotation, panorama.translation, WIDTH, 0.01)
        expected = measure(image, view.image, view.mask)["ws_psnr"]
        assert decibel(error / area) == pytest.approx(expected, abs=1e-9)


def test_colours_are_compared_as_the_exposure_has_them(block: TrainSpec, scene: Scene) -> None:
    model, panorama = before(block), scene.panoramas[0]
    image = render_bytes(model, panorama.rotation, panorama.translation, WIDTH, 0.01)
    affine = torch.tensor([[0.5, 0.6, 0.7], [0.05, 0.1, 0.0]])
    photograph = (image * affine[0] + 255 * affine[1]).round().to(torch.uint8)
    view = replace(load_view(panorama, 0, WIDTH), image=photograph)
    assert squared_error(model, panorama, replace(view, exposure=affine), 0.01)[0] == 0
    assert squared_error(model, panorama, view, 0.01)[0] > 1


def test_a_model_with_a_block_has_all_others_and_the_sky(block: TrainSpec) -> None:
    assert block.cell is not None
    coarse = before(block)
    within = block.cell.contains(coarse.means.numpy())
    within[coarse.scene.stop :] = False
    brighter = replace(kept(block), sh0=kept(block).sh0 + 1)
    model = with_block(coarse, block.cell, brighter)
    assert len(model) == len(coarse) and model.sky == coarse.sky == 60
    assert torch.equal(model.sh0[: len(brighter)], brighter.sh0)
    assert torch.equal(model.means[len(brighter) :], coarse.means[torch.from_numpy(~within)])
