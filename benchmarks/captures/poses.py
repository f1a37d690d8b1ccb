"""Refined poses: a scene whose cameras were moved by chance, Stage I on it, and how much of that is undone.

    python -m benchmarks.captures.poses SCENE [--iterations 1500] [--width 512] [--json]

Each camera, held-out ones too, is moved by a normal vector of `--shift` (world units) and turned by one of
`--turn` degrees. Trained are true poses and moved ones: as they are, refined in Stage I, adjusted to the
tracks before as with `poses.refine=auto`, and both. Errors are those after the similarity that fits the
training cameras best to the truth; held-out panoramas are rendered at their true poses, brought into the
model's frame by it, and at poses that are fitted to them.
"""

import argparse
import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from panolog.orchestrator.run.config import RunConfig
from panolog.prepare.check.bundle import adjust
from panolog.prepare.check.residuals import read_tracks
from panolog.renderer import ops
from panolog.renderer.motion import Common, centers, moved
from panolog.renderer.render import render_bytes
from panolog.scene.gaussians import Gaussians
from panolog.scene.images import PanoramaCache, View
from panolog.scene.model import Scene
from panolog.scene.read import read_scene
from panolog.workers.capture.captured import Captured
from panolog.workers.capture.pose_fit import fit_pose
from panolog.workers.events import Trained
from panolog.workers.metrics import measure
from panolog.workers.specs import Value
from panolog.workers.tasks import COARSE
from panolog.workers.training.initialise import near_distance
from panolog.workers.training.trainer import TrainSpec, train

Array = NDArray[np.float64]
CACHE = 2**30  # bytes of decoded panoramas


@dataclass(frozen=True)
class Errors:
    """How far training cameras are from their true poses, root mean square."""

    shift: float  # world units
    turn: float  # degrees
    pixels: float  # of the training width: shift over the median distance of what is seen, and turn


@dataclass(frozen=True)
class Outcome:
    """One training."""

    name: str
    before: Errors
    after: Errors
    psnr: float  # of held-out panoramas at their true poses
    fitted: float  # the same at fitted poses


def disturbed(scene: Scene, shift: float, turn: float, seed: int) -> Scene:
    """The scene with each camera moved by a normal `shift` in world units and turned by `turn` degrees."""
    rng = np.random.default_rng(seed)
    panoramas = []
    for panorama in scene.panoramas:
        motion = np.concatenate([rng.normal(size=3) * shift, rng.normal(size=3) * np.radians(turn)])
        rotation, translation = moved(panorama.rotation, panorama.translation, motion)
        panoramas.append(replace(panorama, rotation=rotation, translation=translation))
    return replace(scene, panoramas=tuple(panoramas))


def errors(truth: Scene, known: Scene, radius: float, width: int) -> Errors:
    """Those of the training cameras, without what all of them have in common."""
    right, ours = truth.poses[list(truth.train)], known.poses[list(truth.train)]
    ours = Common.of(right, ours, radius).undone_poses(ours)
    turns = Rotation.from_matrix(ours[:, :, :3] @ right[:, :, :3].transpose(0, 2, 1)).magnitude()
    shifts = np.linalg.norm(centers(ours) - centers(right), axis=1)
    shift, turn = (float(np.sqrt(np.mean(np.square(each)))) for each in (shifts, turns))
    return Errors(shift, float(np.degrees(turn)), float(np.hypot(shift / radius, turn)) * width / (2 * np.pi))


def trained(scene: Scene, width: int, config: RunConfig) -> tuple[Gaussians, Captured | None]:
    """Stage I alone."""
    spec = TrainSpec(
        task=COARSE,
        scene=Value(scene),
        views=scene.train,
        width=width,
        iterations=config.iterations,
        config=config,
        seed=config.seed,
    )
    *_, last = train(spec)
    assert isinstance(last, Trained)
    return last.gaussians, last.captured


def quality(
    model: Gaussians, truth: Scene, known: Scene, radius: float, width: int, near: float
) -> tuple[float, float]:
    """Mean PSNR of the held-out panoramas at their true poses, and at poses fitted from there."""
    found: list[tuple[float, float]] = []
    common = Common.of(known.poses[list(truth.train)], truth.poses[list(truth.train)], radius)
    there = dict(zip(truth.test, common.undone_poses(truth.poses[list(truth.test)]), strict=True))
    with PanoramaCache(truth, truth.test, width, CACHE) as cache:
        for row in truth.test:
            view, panorama = cache.get(row), truth.panoramas[row]
            pose = there[row][:, :3], there[row][:, 3]
            fitted = fit_pose(model, view, *pose, points=truth.points[panorama.observed], near=near)
            tried = (pose, (fitted.rotation, fitted.translation))
            first, second = (psnr(model, view, turn, shift, width, near) for turn, shift in tried)
            found.append((first, second))
    means = np.mean(found, axis=0)
    return float(means[0]), float(means[1])


def psnr(model: Gaussians, view: View, rotation: Array, translation: Array, width: int, near: float) -> float:
    """Of a held-out panorama at a pose."""
    image = render_bytes(model, rotation, translation, width, near)
    value = measure(image, view.image, view.mask)["psnr"]
    assert value is not None
    return value


def outcome(
    name: str, truth: Scene, given: Scene, adjusts: bool, refine: bool, config: RunConfig, width: int
) -> Outcome:
    """One training on given poses, against the truth."""
    settings = config.poses.model_copy(update={"refine": refine})
    tracks = read_tracks(truth) if adjusts else None
    begun = given if tracks is None else adjust(given, tracks).applied(given)
    model, captured = trained(begun, width, config.model_copy(update={"poses": settings}))
    known = begun if captured is None else captured.applied(begun)
    seen = [truth.points[p.observed] - p.center for p in truth.panoramas if len(p.observed)]
    radius = float(np.median([np.median(np.linalg.norm(each, axis=1)) for each in seen])) if seen else 1.0
    near = near_distance(truth, config)
    before, after = (errors(truth, each, radius, width) for each in (given, known))
    return Outcome(name, before, after, *quality(model, truth, known, radius, width, near))


PARTS = ("moved", "adjusted", "refined")
CASES = ("true", "true, refined", "moved", "moved, refined", "moved, adjusted", "moved, adjusted, refined")


def parse(argv: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.captures.poses", description=__doc__)
    parser.add_argument("scene", type=Path)
    parser.add_argument("--iterations", type=int, default=1500)
    parser.add_argument("--width", type=int, default=512)
    parser.add_argument("--shift", type=float, default=0.03, help="world units, of each coordinate")
    parser.add_argument("--turn", type=float, default=0.12, help="degrees, about each axis")
    parser.add_argument("--only", choices=CASES, action="append", help="one of the trainings")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="of `poses`")
    parser.add_argument("--gaussians", type=int, default=60_000)
    parser.add_argument("--json", action="store_true")
    return parser.parse_args(argv)


def main(argv: Sequence[str] | None = None) -> int:
    """Prints one row for each training."""
    given = parse(argv)
    ops.use_threads(None)
    truth = read_scene(given.scene)
    chosen = dict(pair.split("=", 1) for pair in given.set)
    config = RunConfig.model_validate(
        {
            "iterations": given.iterations,
            "densify": {"max_gaussians": given.gaussians},
            "poses": {"refine": True, **{key: float(value) for key, value in chosen.items()}},
            "preview": {"every": 10**6},
        }
    )
    wrong = disturbed(truth, given.shift, given.turn, seed=1)
    found = []
    for name in given.only or CASES:
        by_chance, adjusts, refine = (part in name for part in PARTS)
        row = outcome(name, truth, wrong if by_chance else truth, adjusts, refine, config, given.width)
        found.append(row)
        if not given.json:
            print(
                f"{name}: {row.before} to {row.after}, PSNR {row.psnr:.2f}, fitted {row.fitted:.2f}",
                flush=True,
            )
    if given.json:
        print(json.dumps([asdict(row) for row in found], indent=1))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
