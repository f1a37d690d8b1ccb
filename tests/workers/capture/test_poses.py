"""Poses as Stage I refines them: bounds, gauge, checkpoints, and that they find the truth."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from panolog.renderer.motion import MOTION, MOTION_SUMS, Common, centers, moved
from panolog.scene.model import Panorama, Scene
from panolog.workers.capture.config import PosesConfig
from panolog.workers.capture.poses import Metric, Poses, Schedule, refines

Array = NDArray[np.float64]
VIEWS, ITERATIONS = 8, 1000
STEEP = 200.0  # of the loss per radian²


@pytest.fixture
def scene() -> Scene:
    rng = np.random.default_rng(0)
    points = rng.normal(size=(400, 3)) * 5
    panoramas = []
    for number in range(VIEWS):
        rotation, translation = moved(np.eye(3), np.zeros(3), rng.normal(size=6))
        seen = np.arange(400) if number else np.arange(3)  # the first has too few for its own metric
        panoramas.append(Panorama(f"{number}.png", Path(f"{number}.png"), rotation, translation, seen))
    colors, rows = np.zeros((400, 3), np.uint8), tuple(range(VIEWS))
    return Scene(Path(), 1024, 512, tuple(panoramas), points, colors, rows, (), "")


def poses(scene: Scene, **settings: float) -> Poses:
    config = PosesConfig.model_validate({"refine": True, "begin": 0, "visits": 0, **settings})
    made = Poses.of(scene, scene.train, config, ITERATIONS)
    assert made is not None
    return made


def sums_of(gradient: Array, noise: float = 1e-3) -> Array:
    """What the kernels would sum for a gradient whose parts are alike in all directions."""
    moments = np.eye(MOTION) * noise
    return np.concatenate([gradient, moments[np.triu_indices(MOTION)]])


def pulled(
    made: Poses, target: dict[int, Array], rounds: int = 40, steep: float = STEEP, last: int = ITERATIONS
) -> list[float]:
    """Steps with the gradients of the squared angles from targets; returns how far all have moved."""
    lengths = []
    for number in range(rounds * VIEWS):
        row = number % VIEWS
        factor = made._metrics[row].factor
        gradient = steep * factor @ factor.T @ (made._motion[row] - target[row])
        made.step(row, 1 + number * last // (rounds * VIEWS), sums_of(gradient))
        lengths.append(float(np.linalg.norm(made._motion)))
    return lengths


def motions(seed: int, size: float) -> dict[int, Array]:
    rng = np.random.default_rng(seed)
    return {row: rng.normal(size=MOTION) * size for row in range(VIEWS)}


def test_the_metric_is_the_mean_angle_of_what_moves(scene: Scene) -> None:
    panorama = scene.panoramas[3]
    metric = Metric.of(panorama.rotation, panorama.translation, scene.points, 2.0)
    motion = np.random.default_rng(1).normal(size=MOTION) * 1e-4
    before, after = (
        scene.points @ rotation.T + translation
        for rotation, translation in (
            (panorama.rotation, panorama.translation),
            moved(panorama.rotation, panorama.translation, motion),
        )
    )
    directions = [each / np.linalg.norm(each, axis=1, keepdims=True) for each in (before, after)]
    angles = np.linalg.norm(directions[1] - directions[0], axis=1)
    assert metric.angle(motion) == pytest.approx(float(np.sqrt((angles**2).mean())), rel=0.02)


def test_steps_find_what_gradients_point_to(scene: Scene) -> None:
    """But for what all have in common, and a share for the tie to where they began."""
    target, made = motions(2, 2e-3), poses(scene, rate=0.3)
    pulled(made, target)
    wanted = poses(scene)
    wanted._motion = np.stack([target[row] for row in range(VIEWS)])
    for _ in range(3):
        wanted._hold_gauge()
    share = (made._motion * wanted._motion).sum() / (wanted._motion**2).sum()
    assert 0.55 < share < 0.75
    assert np.linalg.norm(made._motion - share * wanted._motion) < 0.25 * np.linalg.norm(wanted._motion)


@pytest.mark.parametrize("steep", [20.0, 20_000.0])
def test_steps_do_not_overshoot_however_steep_the_loss_is(steep: float, scene: Scene) -> None:
    target, made = motions(2, 2e-3), poses(scene, rate=0.2, decay=0.1)
    lengths = pulled(made, target, 60, steep, last=60 * VIEWS)
    assert max(lengths) < 1.5 * np.linalg.norm(np.stack(list(target.values())))
    last = np.diff(lengths[-10 * VIEWS :])  # the gauge takes a little back after each pass
    assert np.abs(last).max() < 0.1 * lengths[-1]


def bent(made: Poses) -> float:
    """How far the cameras are off in z at most, world units."""
    return float(np.abs(centers(made.learnt())[:, 2]).max())


def test_what_cameras_around_each_other_have_in_common_is_taken_out(scene: Scene) -> None:
    """A street of a hundred cameras that is bent a little, and one camera that is off by itself."""
    panoramas, seen = [], np.arange(400)
    for number in range(100):
        panoramas.append(
            replace(
                scene.panoramas[1],
                rotation=np.eye(3),
                translation=np.array([-2.0 * number, 0.0, 0.0]),
                observed=seen,
            )
        )
    rows = tuple(range(100))
    made = poses(replace(scene, panoramas=tuple(panoramas), train=rows))
    for at in rows:
        turn = Rotation.from_rotvec([0.0, -4e-5 * at, 0.0]).as_matrix()
        center = np.array([2.0 * at, 0.0, 4e-5 * at**2])
        made._motion[at] = np.concatenate([-turn.T @ center + turn.T @ [2.0 * at, 0, 0], [0, 4e-5 * at, 0]])
    made._motion[50, 1] += 0.05
    before = bent(made)
    for _ in range(3):
        made._hold_gauge()
    assert bent(made) < 0.1 * before
    assert made._motion[50, 1] > 0.03


def test_a_move_that_all_have_in_common_is_taken_out(scene: Scene) -> None:
    made, start = poses(scene), poses(scene).learnt()
    shift, angle, growth = np.array([0.01, -0.02, 0.005]), np.array([0.002, 0.001, -0.003]), 1.002
    turn = Rotation.from_rotvec(angle).as_matrix()
    middle = scene.centers.mean(0)
    for at, panorama in enumerate(scene.panoramas):
        center = middle + shift + growth * turn @ (panorama.center - middle)
        rotation = panorama.rotation @ turn.T
        delta = rotation @ panorama.rotation.T
        translation = -rotation @ center
        made._motion[at] = np.concatenate(
            [translation - delta @ panorama.translation, Rotation.from_matrix(delta).as_rotvec()]
        )
    assert np.abs(made.learnt() - start).max() > 1e-3
    for _ in range(3):
        made._hold_gauge()
    assert np.abs(made.learnt() - start).max() < 1e-6


def test_no_view_moves_farther_than_its_bound(scene: Scene) -> None:
    made = poses(scene, rate=5.0, most=2.0)
    pulled(made, motions(3, 1.0))
    angles = np.array([m.angle(x) for m, x in zip(made._metrics, made._motion, strict=True)])
    assert (angles <= made.bounds * (1 + 1e-9)).all()
    assert made.at_bound().any()
    assert made.bounds[1:] == pytest.approx(2 * 2 * np.pi / 1024)


def test_true_poses_stay(scene: Scene) -> None:
    """Gradients that chance draws about those of poses that are right do not add up."""
    made, rng, pixel = poses(scene), np.random.default_rng(5), 2 * np.pi / 1024
    for number in range(100 * VIEWS):
        at = number % VIEWS
        metric = made._metrics[at].factor @ made._metrics[at].factor.T
        drawn = STEEP * (
            metric @ made._motion[at] + made._metrics[at].factor @ rng.normal(size=6) * 0.3 * pixel
        )
        made.step(at, 1 + number * ITERATIONS // (100 * VIEWS), sums_of(drawn))
    angles = [metric.angle(motion) for metric, motion in zip(made._metrics, made._motion, strict=True)]
    assert max(angles) < 0.2 * pixel


@pytest.mark.parametrize("broken", [np.nan, np.inf])
def test_what_is_not_finite_teaches_nothing(broken: float, scene: Scene) -> None:
    made = poses(scene)
    made.step(2, 10, np.full(MOTION_SUMS, broken))
    made.step(3, 10, np.zeros(MOTION_SUMS))
    assert not made._motion.any()


def test_a_checkpoint_continues_with_the_same_bytes(scene: Scene) -> None:
    whole, first, resumed = (poses(scene) for _ in range(3))
    rng = np.random.default_rng(6)
    for number in range(5 * VIEWS + 3):
        if number == 21:
            resumed.restore(first.tensors())
        step = number % VIEWS, number + 1, sums_of(rng.normal(size=6))
        for each in (whole, first if number < 21 else resumed):
            each.step(*step)
    assert whole.learnt().tobytes() == resumed.learnt().tobytes()
    assert all(resumed.tensors()[name].equal(tensor) for name, tensor in whole.tensors().items())


def test_when_poses_are_refined(scene: Scene) -> None:
    def chosen(refine: bool | str, residual: float | None) -> bool:
        known = replace(scene, panoramas=tuple(replace(p, residual=residual) for p in scene.panoramas))
        return refines(known, known.train, PosesConfig.model_validate({"refine": refine}))

    assert chosen(True, None) and not chosen(False, 50.0)
    assert not chosen("auto", None) and not chosen("auto", 0.4) and chosen("auto", 3.0)


def test_nothing_moves_before_it_begins(scene: Scene) -> None:
    made = poses(scene, begin=0.5)
    assert not made.moves(499) and made.moves(500)
    made.step(1, 499, sums_of(np.ones(6)))
    assert not made._motion.any()


def test_the_common_similarity_of_one_center_is_finite() -> None:
    before = np.tile(np.eye(3, 4), (4, 1, 1))
    after = before.copy()
    after[:, :, 3] -= 1  # of a camera with these axes the centre is minus that
    found = Common.of(before, after, 1.0)
    assert found.shift == pytest.approx(np.ones(3)) and found.growth == pytest.approx(0)
    assert found.undone_poses(after) == pytest.approx(before)


@pytest.mark.parametrize(("iterations", "begins"), [(100, 50), (1000, 200), (300, 80)])
def test_poses_wait_until_the_scene_has_shape(iterations: int, begins: int) -> None:
    """A fifth of Stage I and eight visits of each of ten views, but no more than half of Stage I."""
    schedule = Schedule.of(PosesConfig(), 10, iterations, 1.0)
    assert schedule.at(begins - 1) == 0 and schedule.at(begins) == 0.4
    assert schedule.at(iterations) == pytest.approx(0.004)
