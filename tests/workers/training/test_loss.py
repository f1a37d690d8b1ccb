"""The target of the depth loss: images that cannot be aligned are left out, sky is 0."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from panolog.partition.bounds import baseline
from panolog.scene.images import View, load_view
from panolog.scene.model import Scene
from panolog.workers.training.config import DepthConfig, TrainConfig
from panolog.workers.training.loss import DepthTargets, Loss
from panolog.workers.training.schedule import Schedule
from tests.on_device import OnDevice, view_on_device
from tests.workers.small import AFFINE, RADIUS, WIDTH, small_scene


def view_of(scene: Scene, row: int = 1) -> View:
    return load_view(scene.panoramas[row], row, WIDTH)


@pytest.mark.parametrize("affine", [(0.0, 0.1), (77.0, 0.1), (float("nan"), 0.1)])
def test_a_wrong_affine_of_the_scene_gives_the_target_of_the_fit_and_one_notice(
    scene: Scene, affine: tuple[float, float]
) -> None:
    panoramas = tuple(replace(panorama, depth_affine=affine) for panorama in scene.panoramas)
    targets = DepthTargets(replace(scene, panoramas=panoramas), DepthConfig(), 0)
    found, again = targets.target(view_of(scene)), targets.target(view_of(scene))
    fitted = DepthTargets(scene, DepthConfig(), 0).target(view_of(scene))
    assert found is not None and again is not None and fitted is not None
    assert torch.equal(found[0], fitted[0])
    (notice,) = targets.notices
    assert notice.startswith("pano_1.png: its affine") and notice.endswith("fitted again")


def test_implausible_images_are_left_out_and_named_once(scene: Scene) -> None:
    view = view_of(scene)
    assert view.inverse_depth is not None
    noise = torch.from_numpy(np.random.default_rng(0).uniform(0.1, 1, view.inverse_depth.shape)).float()
    cases = {
        "not positive": replace(view, inverse_depth=(1 - view.inverse_depth).clamp(min=0)),
        "of the points' spread": replace(view, inverse_depth=noise + view.inverse_depth),
        "the same at all": replace(view, inverse_depth=torch.full_like(noise, 0.5)),
    }
    for reason, wrong in cases.items():
        targets = DepthTargets(scene, DepthConfig(), 0)
        assert targets.target(wrong) is None and targets.target(wrong) is None
        assert len(targets.notices) == 1
        assert "pano_1.png is left out" in targets.notices[0] and reason in targets.notices[0]


def test_target_is_inverse_depth_and_zero_in_the_sky_if_that_counts(scene: Scene) -> None:
    view = view_of(scene, 0)  # 0.3 from the middle of the sphere
    panoramas = tuple(replace(panorama, depth_affine=AFFINE) for panorama in scene.panoramas)
    counting = DepthTargets(replace(scene, panoramas=panoramas), DepthConfig(sky=True), 0)
    found, ground = counting.target(view), DepthTargets(counting.scene, DepthConfig(), 0).target(view)
    assert found is not None and ground is not None and view.sky is not None and view.mask is not None
    target, valid = found
    assert torch.equal(ground[1], view.mask & ~view.sky)
    assert torch.equal(target[ground[1]], ground[0][ground[1]])
    assert (target[view.sky] == 0).all()
    distance = 1 / target[~view.sky]
    assert distance.amin().item() == pytest.approx(RADIUS - 0.3, rel=0.01)
    assert distance.amax().item() == pytest.approx(RADIUS + 0.3, rel=0.01)
    assert torch.equal(valid, view.mask)
    assert not valid[-1].any() and valid[0].all()


def test_a_hole_of_the_prior_is_not_sky_where_a_sky_mask_says_so(scene: Scene) -> None:
    view = view_of(scene, 0)
    assert view.inverse_depth is not None and view.sky is not None
    ground = (~view.sky).nonzero()[0]
    view.inverse_depth[ground[0], ground[1]] = 0
    panoramas = tuple(replace(panorama, depth_affine=AFFINE) for panorama in scene.panoramas)
    targets = DepthTargets(replace(scene, panoramas=panoramas), DepthConfig(), 0)
    with_mask, without = targets.target(view), targets.target(replace(view, sky=None))
    assert with_mask is not None and not with_mask[1][ground[0], ground[1]]
    assert without is not None and without[0][ground[0], ground[1]] == 0


def test_the_weight_is_that_of_the_paper_or_in_units_of_the_baseline(scene: Scene) -> None:
    length = baseline(scene.centers[list(scene.train)])
    for unit, factor in (("world", 1.0), ("baseline", length)):
        config = TrainConfig.model_validate({"depth": {"unit": unit}})
        loss = Loss(scene, config, 0, Schedule(config, 100, extent=1.0, refine=False))
        assert loss.depth_weight(100) == pytest.approx(0.01 * factor)


def test_a_view_without_depth_has_no_target(tmp_path: Path) -> None:
    scene = small_scene(tmp_path, layers=False)
    targets = DepthTargets(scene, DepthConfig(), 0)
    assert targets.target(view_of(scene)) is None and not targets.notices


def test_targets_are_made_on_the_device_of_the_view(scene: Scene) -> None:
    """With the bytes of the CPU; after the alignment nothing leaves the device."""
    ours, theirs = (DepthTargets(scene, DepthConfig(), 0) for _ in range(2))
    for row in (0, 1, 2):
        view = view_of(scene, row)
        expected, found = ours.target(view), theirs.target(view_on_device(view))
        before = OnDevice.copies
        again = theirs.target(view_on_device(view))
        assert OnDevice.copies == before
        assert expected is not None and found is not None and again is not None
        for truth, first, second in zip(expected, found, again, strict=True):
            assert isinstance(first, OnDevice) and torch.equal(first.cpu(), truth)
            assert torch.equal(second.cpu(), truth)


def test_a_depth_map_stays_aligned_as_it_was_before_something_was_found_to_move(scene: Scene) -> None:
    """A resumed training, which sees the view with that first, aligns it by the view's own mask too."""
    view, config = view_of(scene), TrainConfig()
    assert view.inverse_depth is not None and view.mask is not None
    noise = np.random.default_rng(0).uniform(0.995, 1.005, view.inverse_depth.shape)
    still = view.mask.clone()
    still[8:20, 10:40] = False
    view = replace(view, inverse_depth=view.inverse_depth * torch.from_numpy(noise).float())
    moving = replace(view, mask=still)
    ours, fresh = (Loss(scene, config, 0, Schedule(config, 100, extent=1.0, refine=False)) for _ in range(2))
    assert ours.aligned(view, 1) is view
    found, other = ours.depth.target(moving), fresh.depth.target(moving)
    plain = DepthTargets(scene, config.depth, 0).target(view)
    assert found is not None and other is not None and plain is not None
    assert torch.equal(found[0], plain[0]) and not torch.equal(found[0], other[0])
