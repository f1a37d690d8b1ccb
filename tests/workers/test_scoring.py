from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from panolog.partition.bounds import baseline
from panolog.renderer.camera import Camera
from panolog.renderer.losses import photometric_loss, sphere_rows
from panolog.renderer.render import render
from panolog.scene.errors import RunError
from panolog.scene.gaussians import Gaussians, concatenate
from panolog.scene.images import load_view
from panolog.scene.model import Scene
from panolog.workers.events import Scored
from panolog.workers.scoring import ScoreSpec, _gradient, in_shards
from panolog.workers.specs import Value
from panolog.workers.tasks import Progress
from panolog.workers.training.config import TrainConfig
from panolog.workers.training.initialise import scene_gaussians
from tests.renderer.cuda.stubbed import stubbed, without_pairs
from tests.renderer.cuda.waits import counted
from tests.workers.small import WIDTH, small_scene
from tests.workers.trainings import score_of, scored, threads


def with_sky(scene: Scene) -> Gaussians:
    """The scene's initial Gaussians, and ten of them again, farther away, as its sky."""
    gaussians = scene_gaussians(scene)
    sky = gaussians.select(torch.arange(len(gaussians)) < 10)
    return concatenate(gaussians, replace(sky, means=3 * sky.means, sky=10))


def spec_of(scene: Scene, views: tuple[int, ...] = (0, 1, 3)) -> ScoreSpec:
    spec = score_of(scene, with_sky(scene), views)
    return replace(spec, labels=Value(2 * spec.labels.load()), blocks=3)  # block 1 is empty


def by_definition(spec: ScoreSpec, row: int) -> list[float]:
    """Eq. 10 as it is written."""
    scene, config = spec.scene.load(), spec.config
    gaussians, labels = spec.model.load(), spec.labels.load()
    panorama = scene.panoramas[row]
    means = gaussians.means.clone().requires_grad_()
    camera = Camera.of(panorama.rotation, panorama.translation, WIDTH, WIDTH // 2)
    near = config.near * baseline(scene.centers[:4])
    color = render(replace(gaussians, means=means), camera, near=near).color
    view = load_view(panorama, row, WIDTH)
    rows = sphere_rows(WIDTH // 2, view.mask, "cpu") if config.loss.sphere else None
    photometric_loss(color, view.image, view.mask, config.loss.lambda_ssim, rows).loss.backward()  # type: ignore[no-untyped-call]
    assert means.grad is not None
    norms = means.grad[gaussians.scene].double().abs().sum(1)
    return [
        float(norms[torch.from_numpy(labels == b)].mean()) if (labels == b).any() else 0.0 for b in range(3)
    ]


@pytest.mark.parametrize("sphere", [False, True])
def test_scores_are_those_of_the_definition(scene: Scene, sphere: bool) -> None:
    spec = spec_of(scene)
    spec = replace(spec, config=TrainConfig.model_validate({"loss": {"sphere": sphere}}))
    means = spec.model.load().means
    before = means.clone()
    *progress, last = spec.run()
    assert torch.equal(means, before) and not means.requires_grad
    assert isinstance(last, Scored)
    assert last.cameras == (0, 1, 3)
    assert last.scores.dtype == torch.float64
    expected = [by_definition(spec, row) for row in (0, 1, 3)]
    np.testing.assert_allclose(last.scores.numpy(), expected, rtol=1e-9)
    assert (last.scores[:, [0, 2]] > 0).all()
    assert isinstance(progress[-1], Progress)
    assert (progress[-1].iteration, progress[-1].iterations) == (3, 3)


def test_of_merged_gaussians_the_number_that_they_stand_for_counts(scene: Scene) -> None:
    spec = spec_of(scene)
    held = np.bincount(spec.labels.load(), minlength=3)
    merged = scored(replace(spec, sizes=(2 * int(held[0]), 0, 4 * int(held[2]))))
    torch.testing.assert_close(merged * torch.tensor([2.0, 1.0, 4.0]), scored(spec))


def test_shards_score_as_the_whole_does_whatever_the_threads(scene: Scene) -> None:
    found = []
    for count, views, row in ((1, (0, 1, 3), 1), (2, (0, 1, 3), 1), (1, (1,), 0)):
        with threads(count):
            found.append(scored(spec_of(scene, views))[row])
    assert torch.equal(found[0], found[1]) and torch.equal(found[0], found[2])


def test_a_view_that_is_masked_altogether_scores_zero(tmp_path: Path) -> None:
    scene = small_scene(tmp_path)
    mask = scene.panoramas[1].mask
    assert mask is not None
    cv2.imwrite(str(mask), np.zeros((WIDTH // 2, WIDTH), np.uint8))
    assert not scored(spec_of(scene, views=(1,))).any()


def test_labels_must_fit(scene: Scene) -> None:
    spec = spec_of(scene)
    with pytest.raises(ValueError, match="labels for"):
        list(replace(spec, labels=Value(spec.labels.load()[:-1])).run())
    with pytest.raises(ValueError, match="0 to 1"):
        list(replace(spec, blocks=2).run())


def test_gradients_that_are_not_finite_stop_the_run(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    spec = spec_of(scene)

    def broken(loss: torch.Tensor, means: torch.Tensor) -> tuple[torch.Tensor]:
        return (torch.full_like(means, torch.nan),)

    monkeypatch.setattr("torch.autograd.grad", broken)
    with pytest.raises(RunError, match="pano_0"):
        list(spec.run())


@pytest.mark.parametrize(
    ("count", "most", "shards"), [(0, 4, 0), (1, 4, 1), (7, 3, 3), (3, 1, 3), (64, 16, 4)]
)
def test_shards_hold_every_camera_once_in_order(count: int, most: int, shards: int) -> None:
    cameras = tuple(range(10, 10 + count))
    parts = in_shards(cameras, most)
    assert sum(parts, ()) == cameras
    assert len(parts) == shards and all(0 < len(part) <= most for part in parts)
    assert not parts or max(map(len, parts)) - min(map(len, parts)) <= 1


def test_on_a_card_nothing_waits_but_the_rasterizer(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It waits for the number of pairs, inside its op; losses are read when there is a report, here once."""
    monkeypatch.setattr("panolog.workers.meter.INTERVAL", np.inf)
    spec = spec_of(small_scene(tmp_path, layers=False))
    with stubbed(without_pairs), counted() as found:
        scores = scored(spec)
    assert not scores.any()
    del found["cpu"]  # of poses, which are there, and once of the scores
    assert found == {"tolist": 1, "to": 8}  # once: the model's six tensors, labels and sizes


def test_the_loss_is_of_colours_as_the_exposure_has_them(scene: Scene) -> None:
    spec, view = spec_of(scene), load_view(scene.panoramas[0], 0, WIDTH)
    model = with_sky(scene)
    model.means.requires_grad_()
    affine = torch.tensor([[0.5, 0.6, 0.7], [0.05, 0.1, 0.0]])
    panorama = scene.panoramas[0]
    camera = Camera.of(panorama.rotation, panorama.translation, WIDTH, WIDTH // 2)
    color = render(model, camera, sh_degree=3, near=0.01).color.detach() * affine[0] + affine[1]
    view = replace(view, image=(color.clamp(0, 1) * 255).round().to(torch.uint8))
    fitting = _gradient(spec, scene, model, replace(view, exposure=affine), 0.01)[0]
    plain = _gradient(spec, scene, model, view, 0.01)[0]
    assert float(fitting.l1) < 0.01
    assert float(plain.l1) > 0.03
