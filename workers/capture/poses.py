"""The poses of panoramas, refined in Stage I: a motion (`renderer.motion`) of each training camera.

Motions are measured by the root mean square of the angles by which they move what a camera sees: in a basis
in which that is the length of a vector, all directions of a pose are alike. There a step is the gradient over
a curvature that all cameras share, so that gradients of poses that are right stay without effect. (The
moments of the parts that Gaussians have in the gradient are a worse metric.)

What cameras around each other have in common, pictures do not show: the place moves along, and every small
force adds up until a street is bent. So after each pass over the views the similarity that a camera has in
common with those around it is taken out, and a motion is tied to where it began. It is bounded by what the
poses' own error allows.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from torch import Tensor

from panolog.partition.bounds import baseline
from panolog.renderer.motion import MOTION, Common, Motion, centers, moved, turning
from panolog.scene.model import Panorama, Scene
from panolog.workers.capture.config import PosesConfig

Array = NDArray[np.float64]

_NAME = "poses."  # before the names of checkpoints' tensors
_KEEP = 0.7  # of the mean gradient at each visit of a view, of which there are tens: Adam's is for thousands
_GAIN = 0.4  # of a step: of the way that gradient and curvature show
_TIE = 0.5  # of the curvature: that of the tie to where a camera began
_CURVATURE = 150.0  # of the loss per radian², as it is measured in the first thousands of iterations
_TRUSTED = 1.0  # pixels² of moves whose worth that has; then what gradients change by along moves counts more
_FORGET = 0.9  # kept of the moves before after each pass over the views
_AROUND = 24  # cameras, itself included, that a camera shares its common motion with
_AWAY = 3.0  # baselines to what a camera without points sees
_FEWEST = 20  # points that a camera has to have seen for its own metric; with fewer it is that of a ball
_NEAREST = 0.05  # of the median distance: nearer points do not bend the metric
_AT_BOUND = 0.98


class Metric(NamedTuple):
    """How far a camera's motions move what it sees."""

    factor: Array  # (6, 6) L of the matrix L·Lᵀ whose form is the mean square of the angles, radians²
    distance: float  # median of the points' distances, world units
    seen: int  # points

    @staticmethod
    def of(rotation: Array, translation: Array, points: Array, radius: float) -> "Metric":
        """Half of the points (M, 3) that it sees, half of points all around at their median distance.

        All of points all around, at `radius`, where it sees too few.
        """
        if len(points) < _FEWEST:
            return Metric(np.sqrt(_ball(radius)), radius, len(points))
        local = points @ rotation.T + translation
        distance = np.linalg.norm(local, axis=1)
        median = float(np.median(distance))
        toward = local / np.maximum(distance, 1e-12 * median)[:, None]
        inverse = 1 / np.maximum(distance, _NEAREST * median)
        across = np.eye(3) - toward[:, :, None] * toward[:, None, :]
        moving = np.concatenate([across * inverse[:, None, None], turning(toward)], axis=2)
        square = np.einsum("nij,nik->jk", moving, moving) / len(points)
        square = (square + _ball(median)) / 2  # points lie where a walk leads, and pictures show all around
        return Metric(np.linalg.cholesky(square), median, len(points))

    def angle(self, motion: Array) -> float:
        """Radians, root mean square."""
        return float(np.linalg.norm(self.factor.T @ motion))


@dataclass(frozen=True, eq=False)
class Schedule:
    """When and how far poses move, by iteration of a training."""

    rate: float  # radians that a step is long at most, while the rate is full
    begin: int
    decay: int  # from here on the rate falls
    end: int

    @staticmethod
    def of(config: PosesConfig, views: int, iterations: int, pixel: float) -> "Schedule":
        """Args: pixel, radians that one of the images is wide."""
        shaped = min(config.visits * views, iterations // 2)
        begin = max(round(config.begin * iterations), shaped, 1)
        decay = begin + round((1 - config.decay) * (iterations - begin))
        return Schedule(config.rate * pixel, begin, decay, iterations)

    def at(self, iteration: int) -> float:
        """The rate at an iteration: 0 before it begins; at the end a hundredth."""
        if iteration < self.begin:
            return 0.0
        late = (iteration - self.decay) / max(self.end - self.decay, 1)
        return self.rate * (1.0 if late <= 0 else 0.01 ** min(late, 1.0))


class Poses:
    """The poses of the views of one task."""

    def __init__(
        self,
        originals: Sequence[tuple[Array, Array]],
        metrics: Sequence[Metric],
        bounds: Array,
        views: Sequence[int],
        schedule: Schedule,
        pixel: float,
    ) -> None:
        """Args: originals, the poses as (3, 3) and (3,); bounds (V,), radians that a view may move; pixel,
        radians that one of the images is wide.
        """
        self._at = {row: at for at, row in enumerate(views)}
        self._originals, self._metrics, self.bounds = originals, metrics, bounds
        self._schedule = schedule
        count = len(views)
        self._pixel = pixel
        self._motion = np.zeros((count, MOTION))
        self._mean = np.zeros((count, MOTION))
        self._before = np.zeros((count, 2, MOTION))  # the gradient of the last visit, and where it was
        self._moves = np.zeros(2)  # Σ Δgradient·Δmotion and Σ Δmotion², radians²
        self._visits = np.zeros(count)
        self._given = np.stack([np.column_stack(pose) for pose in originals])
        places, around = centers(self._given), min(_AROUND, count)
        self._around = cKDTree(places).query(places, around)[1].reshape(count, around)

    @staticmethod
    def of(scene: Scene, views: Sequence[int], config: PosesConfig, iterations: int) -> "Poses | None":
        """None if they are not refined: so "auto" has it where no residual is above its threshold."""
        if not refines(scene, views, config):
            return None
        panoramas = [scene.panoramas[row] for row in views]
        radius = _AWAY * baseline(scene.centers[list(views)])
        metrics = [
            Metric.of(each.rotation, each.translation, scene.points[each.observed], radius)
            for each in panoramas
        ]
        bounds = np.array([_bound(scene, *pair, config) for pair in zip(panoramas, metrics, strict=True)])
        pixel = 2 * np.pi / scene.width
        schedule = Schedule.of(config, len(views), iterations, pixel)
        return Poses(
            [(p.rotation, p.translation) for p in panoramas], metrics, bounds, views, schedule, pixel
        )

    def of_view(self, row: int) -> tuple[Array, Array]:
        """The (3, 3) rotation and (3,) translation of a view as known now."""
        at = self._at[row]
        return moved(*self._originals[at], self._motion[at])

    def moves(self, iteration: int) -> bool:
        """Whether an iteration is to learn of poses."""
        return self._schedule.at(iteration) > 0

    def step(self, row: int, iteration: int, sums: NDArray[np.float64]) -> None:
        """Learns from the (27,) sums of an iteration with a view, as `renderer.motion.Motion` has them."""
        rate = self._schedule.at(iteration)
        if rate <= 0 or not np.isfinite(sums).all():
            return
        at = self._at[row]
        factor = self._metrics[at].factor
        inverse = np.linalg.inv(factor)
        gradient, place = inverse @ Motion.of(sums).gradient, factor.T @ self._motion[at]
        visits = self._visits[at] = self._visits[at] + 1
        if visits > 1:
            changed, moved_by = gradient - self._before[at, 0], place - self._before[at, 1]
            self._moves += changed @ moved_by, moved_by @ moved_by
        self._before[at] = gradient, place
        self._mean[at] = _KEEP * self._mean[at] + (1 - _KEEP) * gradient
        mean = self._mean[at] / (1 - _KEEP**visits)
        step = -_GAIN * (mean / self.curvature + _TIE * place)
        step *= rate / max(float(np.linalg.norm(step)), rate)
        self._motion[at] = self._bounded(at, _composed(inverse.T @ step, self._motion[at]))
        if int(self._visits.sum()) % len(self._visits) == 0:
            self._moves *= _FORGET
            self._hold_gauge()

    @property
    def curvature(self) -> float:
        """The curvature of the loss per radian², as gradients changed along moves; at least the first one."""
        trusted = _TRUSTED * self._pixel**2
        measured = (trusted * _CURVATURE + self._moves[0]) / (trusted + self._moves[1])
        return float(max(measured, _CURVATURE))

    def _bounded(self, at: int, motion: Array) -> Array:
        """A motion within the bound of its camera."""
        angle, bound = self._metrics[at].angle(motion), self.bounds[at]
        return motion if angle <= bound else motion * (bound / angle)

    def _hold_gauge(self) -> None:
        """Takes out what the motion of each camera has in common with those around it."""
        refined = self.learnt()
        for at, near in enumerate(self._around):
            common = Common.of(self._given[near], refined[near], self.radius)
            pose = common.undone_poses(refined[at : at + 1])[0]
            self._motion[at] = self._bounded(at, _between(self._originals[at], pose[:, :3], pose[:, 3]))

    @property
    def radius(self) -> float:
        """The median of the distances of what the cameras see, world units."""
        return float(np.median([metric.distance for metric in self._metrics]))

    def learnt(self) -> Array:
        """(V, 3, 4) the pose of each view."""
        poses = [moved(*pose, motion) for pose, motion in zip(self._originals, self._motion, strict=True)]
        return np.stack([np.column_stack(pose) for pose in poses])

    def at_bound(self) -> NDArray[np.bool_]:
        """(V,) which views would have moved on, if they could."""
        angles = [metric.angle(motion) for metric, motion in zip(self._metrics, self._motion, strict=True)]
        return np.array(angles) >= _AT_BOUND * self.bounds

    def tensors(self) -> dict[str, Tensor]:
        """For a checkpoint."""
        state = vars(self)
        return {_NAME + name: torch.from_numpy(state[f"_{name}"].copy()) for name in _STATE}

    def restore(self, tensors: Mapping[str, Tensor]) -> None:
        """The inverse of `tensors`; of a checkpoint without them, the start."""
        for name in _STATE:
            if (tensor := tensors.get(_NAME + name)) is not None:
                setattr(self, f"_{name}", tensor.cpu().numpy().copy())


_STATE = ("motion", "mean", "before", "moves", "visits")


@dataclass(frozen=True)
class Displacement:
    """How far a camera is from where it was."""

    shift: float  # of its centre, world units
    turn: float  # degrees
    angle: float  # radians, root mean square of what it sees


def displacement(before: Panorama, after: Panorama, points: Array) -> Displacement:
    """Args: points (M, 3) that the camera has seen, world units."""
    motion = _between((before.rotation, before.translation), after.rotation, after.translation)
    shift = float(np.linalg.norm(after.center - before.center))
    radius = float(np.median(np.linalg.norm(points - before.center, axis=1))) if len(points) else np.inf
    metric = Metric.of(before.rotation, before.translation, points, radius)
    return Displacement(shift, float(np.degrees(np.linalg.norm(motion[3:]))), metric.angle(motion))


def refines(scene: Scene, views: Sequence[int], config: PosesConfig) -> bool:
    """Whether the poses of these views are refined."""
    if config.refine != "auto":
        return config.refine
    known = [residual for row in views if (residual := scene.panoramas[row].residual) is not None]
    return bool(known) and float(np.median(known)) > config.residual


def _bound(scene: Scene, panorama: Panorama, metric: Metric, config: PosesConfig) -> float:
    """Radians that a camera may move: several times the error of its reprojections, and at least `most`.

    The covariance of a pose under errors that are independent, error / √points, is far below what poses err
    by in practice: then all reprojections are off together. So it counts only where points are few.
    """
    error = panorama.residual or 0.0
    alone = 5 * max(error, 0.3) * np.sqrt(MOTION / max(metric.seen, 1)) if metric.seen else 0.0
    return float(max(config.most, 5 * error, min(alone, 10 * config.most))) * 2 * np.pi / scene.width


def _ball(radius: float) -> Array:
    """(6, 6) the mean square of the angles of points all around."""
    return np.diag(2 / 3 * np.concatenate([np.full(3, 1 / radius**2), np.ones(3)]))


def _composed(step: Array, motion: Array) -> Array:
    """The motion that is `motion` and then `step`."""
    turn = Rotation.from_rotvec(step[3:])
    turned: Array = (turn * Rotation.from_rotvec(motion[3:])).as_rotvec()
    return np.concatenate([turn.apply(motion[:3]) + step[:3], turned])


def _between(original: tuple[Array, Array], rotation: Array, translation: Array) -> Array:
    """The motion from an original pose to another one."""
    turn = rotation @ original[0].T
    return np.concatenate([translation - turn @ original[1], Rotation.from_matrix(turn).as_rotvec()])
