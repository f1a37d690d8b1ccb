"""What is timed: a model, random or trained, and some images of it."""

import math
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from panolog.renderer.baked import Baked, bake
from panolog.renderer.camera import Camera
from panolog.scene.errors import InputError
from panolog.scene.gaussians import SH_C0, Gaussians
from panolog.scene.images import load_view
from panolog.scene.ply import read_ply
from panolog.scene.projection import fibonacci_sphere
from panolog.scene.read import read_scene
from panolog.workers.training.config import TrainConfig
from panolog.workers.training.exterior import Exterior
from panolog.workers.training.initialise import near_distance

LENGTH, WIDTH, EAVES, EYE = 60.0, 14.0, 9.0, 1.7  # metres: of the street, of the houses, of the camera
SKY_RADIUS = 400.0  # metres
BLOCKS = ("far", "middle")  # at the end of a street, and around its camera
Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class TrainingView:
    """An image to train on."""

    camera: Camera
    target: Tensor  # (H, W, 3) uint8
    around: Baked | None = None  # the exterior of a block


@dataclass(frozen=True, eq=False)
class Case:
    """A model and images of one size."""

    name: str
    gaussians: Gaussians
    near: float  # world units
    views: tuple[TrainingView, ...]

    def to(self, device: str) -> "Case":
        """A copy on another device."""
        views = tuple(
            TrainingView(view.camera, view.target.to(device), view.around and view.around.to(device))
            for view in self.views
        )
        return Case(self.name, self.gaussians.to(device), self.near, views)


@dataclass(frozen=True)
class CaseSpec:
    """How to make a case; another process can make the same."""

    width: int  # pixels
    count: int = 0  # Gaussians of a random street
    model: str | None = None  # a PLY in place of the street
    scene: str | None = None  # the scene that the model was trained on
    views: int = 3  # number of the scene's training panoramas
    exact: bool = False  # seen along rays, however the model was trained
    block: str | None = None  # of the model this slab alone, of `BLOCKS`, within a baked exterior

    def __post_init__(self) -> None:
        """Raises InputError if there is a model without a scene, or a scene without a model."""
        if (self.model is None) != (self.scene is None):
            raise InputError("--model and --scene go together: the views of a model are those of its scene")

    def make(self) -> Case:
        """The case; panoramas that are smaller than it are enlarged.

        Raises InputError if model or scene cannot be read.
        """
        made = self._as_stored()
        name = f"{made.name}, exact" if self.exact else made.name
        made = replace(made, name=name, gaussians=replace(made.gaussians, exact=self.exact))
        return made if self.block is None else block_case(made, self.block)

    def _as_stored(self) -> Case:
        if self.model is None or self.scene is None:
            return street_case(self.count, self.width)
        scene, gaussians = read_scene(Path(self.scene)), read_ply(Path(self.model))
        views = []
        for row in scene.train[:: max(1, len(scene.train) // self.views)][: self.views]:
            panorama = scene.panoramas[row]
            camera = Camera.of(panorama.rotation, panorama.translation, self.width, self.width // 2)
            views.append(TrainingView(camera, load_view(panorama, row, self.width).image))
        near = near_distance(scene, TrainConfig())
        return Case(f"trained on {scene.root.name}", gaussians, near, tuple(views))


def street_case(count: int, width: int) -> Case:
    """A street of random Gaussians, and a view from its middle with noise for a target."""
    generator = torch.Generator().manual_seed(0)
    target = torch.randint(0, 256, (width // 2, width, 3), generator=generator, dtype=torch.uint8)
    return Case("street", street(count), 0.0, (TrainingView(street_camera(width), target),))


def block_case(case: Case, place: str) -> Case:
    """Of a model the eighth of its Gaussians in a slab across x, with the rest baked for each view.

    Args: place, of `BLOCKS`.
    """
    gaussians, count = case.gaussians, len(case.gaussians) // 8
    along = gaussians.means[gaussians.scene, 0].argsort(stable=True)
    first = {"far": len(along) - count, "middle": (len(along) - count) // 2}[place]
    own = torch.zeros(len(gaussians), dtype=torch.bool)
    own[along[first : first + count]] = True
    order = torch.cat([own.nonzero()[:, 0], (~own).nonzero()[:, 0]])
    arranged = {name: tensor[order] for name, tensor in gaussians.tensors().items()}
    whole = gaussians.with_tensors(arranged, sky=len(gaussians) - count)
    unit = float(gaussians.means.norm(dim=1).min())
    views = tuple(
        replace(view, around=bake(whole, count, view.camera, near=case.near, unit=unit))
        for view in case.views
    )
    return Case(f"{case.name}, {place} block", Exterior.own(whole), case.near, views)


def street(count: int, *, sky: float = 0.2, seed: int = 0) -> Gaussians:
    """`count` Gaussians: flat ones on the road and two rows of houses, round ones in trees, a sky sphere.

    They are densest near the camera in the middle, as in a trained model. The size of each is the distance of
    its neighbours, so more of them are smaller. Opacities are mostly high, some low.

    Args: sky, the fraction of the sky sphere's; seed of all that is random.
    """
    random = np.random.default_rng(seed)
    far = round(count * sky)
    trees = (count - far) // 8
    flat = count - far - trees
    surface, normals = _surfaces(random, flat)
    crowns = random.normal(size=(trees, 3)) * 1.2 + np.array([[12.0, 4.0, 4.5]]) * _sides(random, trees)
    means = np.concatenate([surface, crowns, SKY_RADIUS * fibonacci_sphere(far)])
    distance = np.linalg.norm(means, axis=1)
    # the standard deviation is the gap to the next, if all were spread evenly over the directions
    sigma = distance * math.sqrt(4 * math.pi / count) * np.exp(0.5 * random.standard_normal(count))
    scales = sigma[:, None] * np.exp(0.4 * random.standard_normal((count, 3)))
    scales[:flat, 2] *= 0.1  # thin along the normal
    quats = random.normal(size=(count, 4))
    quats[:flat] = _facing(normals)
    colors = random.uniform(0.1, 0.9, (count, 1)) + 0.1 * random.standard_normal((count, 3))
    return Gaussians(
        means=_tensor(means),
        quats=_tensor(quats),
        scales=_tensor(np.log(scales)),
        opacities=_tensor(random.normal(0.5, 2.0, count)),
        sh0=_tensor((colors[:, None] - 0.5) / SH_C0),
        shN=_tensor(0.03 * random.standard_normal((count, 15, 3))),
        sky=far,
    )


def street_camera(width: int) -> Camera:
    """The camera in the middle of the street: x along it, y down, z across."""
    turn = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
    return Camera.of(turn, np.zeros(3), width, width // 2)


def _surfaces(random: np.random.Generator, count: int) -> tuple[Floats, Floats]:
    """(count, 3) points on road and walls, z up, the camera at the origin; (count, 3) their normals."""
    along = LENGTH / 2 * random.uniform(-1, 1, count) ** 3  # dense near the middle
    across = random.uniform(-1, 1, count) * WIDTH / 2
    road = random.random(count) < 0.4
    side = np.where(random.random(count) < 0.5, 1.0, -1.0)
    high = random.uniform(0, EAVES, count)
    points = np.stack([along, np.where(road, across, side * WIDTH / 2), np.where(road, 0.0, high) - EYE], 1)
    up, sideways = np.array([0.0, 0.0, 1.0]), np.array([0.0, 1.0, 0.0])
    return points, np.where(road[:, None], up, sideways)


def _sides(random: np.random.Generator, count: int) -> Floats:
    """(count, 3) signs that put trees at both ends and both sides of the street."""
    signs = np.where(random.random((count, 3)) < 0.5, 1.0, -1.0)
    signs[:, 2] = 1.0
    return signs


def _facing(normals: Floats) -> Floats:
    """(N, 4) quaternions w x y z that turn z into the normals, each along y or z."""
    half = math.sqrt(0.5)
    sideways = np.array([half, -half, 0.0, 0.0])  # z to y
    upright = np.array([1.0, 0.0, 0.0, 0.0])
    return np.where(normals[:, 1:2] == 1, sideways, upright)


def _tensor(values: Floats) -> torch.Tensor:
    return torch.from_numpy(np.ascontiguousarray(values, np.float32))
