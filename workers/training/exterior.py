"""What surrounds a block: its cameras see it, but the block does not keep it (eq. 12)."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
import torch
from numpy.typing import NDArray

from panolog.partition.cells import Volume
from panolog.renderer.baked import Baked, bake
from panolog.renderer.camera import Camera
from panolog.renderer.process import release_memory
from panolog.renderer.render import render
from panolog.scene.gaussians import Gaussians

_RELEASE = 8  # views: what baking one leaves free is not what the next one needs
CHECKED = 4  # views, at most, on which what is baked is compared with the full render


def inside(gaussians: Gaussians, cell: Volume | None) -> NDArray[np.bool_]:
    """(S,) the scene Gaussians in a block's cell; without one all of them."""
    if cell is None:
        return np.ones(gaussians.scene.stop, np.bool_)
    return cell.contains(gaussians.means[gaussians.scene].cpu().numpy())


def exterior_last(gaussians: Gaussians, cell: Volume | None) -> Gaussians:
    """Those inside of a block's cell first; the others count as sky: they neither train nor densify.

    They are not retained either (eq. 12), so what they are called has no other effect.
    """
    within = inside(gaussians, cell)
    order = np.concatenate([within.nonzero()[0], (~within).nonzero()[0]])
    rows = torch.from_numpy(np.concatenate([order, np.arange(len(within), len(gaussians))]))
    tensors = {name: tensor[rows] for name, tensor in gaussians.tensors().items()}
    return gaussians.with_tensors(tensors, sky=len(gaussians) - int(within.sum()))


@dataclass(eq=False)
class Exterior:
    """A block's frozen exterior, baked for each of its cameras when it is first needed."""

    model: Gaussians | None  # `exterior_last`, on the CPU; None once all cameras are baked
    near: float  # world units
    unit: float  # world units, `bake`
    device: str | torch.device = "cpu"  # on which the block trains
    baked: dict[int, Baked] = field(default_factory=dict)  # by row of the scene's panoramas

    @staticmethod
    def own(model: Gaussians) -> Gaussians:
        """What the block trains."""
        scene = model.scene
        return model.with_tensors({name: tensor[scene] for name, tensor in model.tensors().items()}, sky=0)

    def of(self, row: int, camera: Camera) -> Baked:
        """What one camera sees of it. Raises KeyError if it is not baked and the model is dropped."""
        if row not in self.baked:
            if self.model is None:
                raise KeyError(row)
            baked = bake(self.model, self.model.scene.stop, camera, near=self.near, unit=self.unit)
            self.baked[row] = baked.to(self.device)
            if len(self.baked) % _RELEASE == 0:
                release_memory()
        return self.baked[row]

    def finish(self, cameras: Mapping[int, Camera]) -> str:
        """Drops the model: all of these cameras, by row, are baked. Returns what that took, for the log.

        On some of them what is baked is compared with the full render, as the block starts.
        """
        model, rows = self.model, list(cameras)
        assert model is not None, "a second time"
        found = []
        for row in rows[:: -(-len(rows) // CHECKED)]:
            camera, baked = cameras[row], self.baked[row].to("cpu")
            full = render(model, camera, near=self.near).color
            parts = render(self.own(model), camera, near=self.near, exterior=baked).color
            found.append((full - parts).abs().amax(2)[baked.active(camera.width, camera.height)])
        self.model, size = None, sum(baked.nbytes for baked in self.baked.values())
        release_memory()
        differences = torch.cat([torch.zeros(1), *found])
        return (
            f"baked what surrounds the block for {len(rows)} panoramas, {size / 2**20:.0f} MiB; its colours"
            f" differ from the full render by at most {float(differences.max()):.4f},"
            f" {float(differences.mean()):.5f} on average"
        )
