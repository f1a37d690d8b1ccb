"""Training of Stage I and Stage II: one generator of events."""

from dataclasses import dataclass

from panolog.partition.cells import Cell
from panolog.scene.gaussians import Gaussians
from panolog.scene.model import Scene
from panolog.workers.config import TrainConfig


@dataclass(frozen=True, eq=False)
class TrainTask:
    """What to train: the whole scene (Stage I) or, with `initial` and `cell`, one block of it (Stage II)."""

    name: str  # "coarse" or "block/007"
    scene: Scene
    views: tuple[int, ...]  # rows of scene.panoramas to train on; may be empty for a block
    width: int  # pixels to train at; height is width / 2
    iterations: int
    config: TrainConfig
    seed: int
    device: str = "cpu"
    initial: Gaussians | None = None  # Stage II: the full Stage I model, sky last
    cell: Cell | None = None  # Stage II: what the block keeps at its end (eq. 12)

    def __post_init__(self) -> None:
        if (self.initial is None) != (self.cell is None):
            raise ValueError(f"task {self.name}: a block needs both its initial Gaussians and its cell")
