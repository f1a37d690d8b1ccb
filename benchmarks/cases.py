"""What is timed: a model and some images of it."""

from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from benchmarks.street import middle, street
from panolog.renderer.camera import Camera
from panolog.scene.gaussians import Gaussians
from panolog.scene.images import load_view
from panolog.scene.model import Scene
from panolog.scene.ply import read_ply
from panolog.scene.read import read_scene
from panolog.workers.training.config import TrainConfig
from panolog.workers.training.initialise import near_distance


@dataclass(frozen=True, eq=False)
class Shot:
    """One image to train on."""

    camera: Camera
    target: Tensor  # (H, W, 3) uint8

    @property
    def pixels(self) -> int:
        return self.camera.width * self.camera.height


@dataclass(frozen=True, eq=False)
class Case:
    """A model and images of one size."""

    name: str
    gaussians: Gaussians
    near: float  # world units
    shots: tuple[Shot, ...]

    def to(self, device: str) -> "Case":
        """The same on another device."""
        shots = tuple(Shot(shot.camera.to(device), shot.target.to(device)) for shot in self.shots)
        return Case(self.name, self.gaussians.to(device), self.near, shots)


@dataclass(frozen=True)
class Recipe:
    """How a case is made, in words that another process understands."""

    width: int  # pixels
    count: int = 0  # Gaussians of a random street
    model: str | None = None  # a PLY instead of the street,
    scene: str | None = None  # the scene that it was trained on
    views: int = 3  # and how many of the scene's training panoramas

    def make(self) -> Case:
        """Raises InputError if model or scene cannot be read."""
        if self.model is None or self.scene is None:
            return random_case(self.count, self.width)
        scene = read_scene(Path(self.scene))
        name = f"trained on {scene.root.name}"
        return scene_case(name, read_ply(Path(self.model)), scene, self.width, self.views)


def random_case(count: int, width: int) -> Case:
    """A street of random Gaussians."""
    return Case("street", street(count), 0.0, (random_shot(width),))


def random_shot(width: int) -> Shot:
    """The middle of the street, with noise for a target."""
    generator = torch.Generator().manual_seed(0)
    target = torch.randint(0, 256, (width // 2, width, 3), generator=generator, dtype=torch.uint8)
    return Shot(middle(width), target)


def scene_case(name: str, gaussians: Gaussians, scene: Scene, width: int, views: int) -> Case:
    """A model with some training panoramas of its scene, enlarged where they are smaller.

    Raises InputError if a panorama cannot be decoded.
    """
    rows = scene.train[:: max(1, len(scene.train) // views)][:views]
    shots = []
    for row in rows:
        panorama = scene.panoramas[row]
        camera = Camera.of(panorama.rotation, panorama.translation, width, width // 2)
        shots.append(Shot(camera, load_view(panorama, row, width).image))
    return Case(name, gaussians, near_distance(scene, TrainConfig()), tuple(shots))
