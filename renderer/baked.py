"""The frozen exterior of a block, baked for one camera: what an iteration needs of it (csrc/bake.h).

Own Gaussians lie along a ray between what is before and what is behind them. Both are composited once. What
lies among them stays a list of splats, and tiles in which no own Gaussian can be seen are left out.
"""

from dataclasses import dataclass, fields

import torch
from torch import Tensor

from panolog.renderer import ops
from panolog.renderer.camera import Camera
from panolog.scene.gaussians import Gaussians

TILE = 16  # pixels, kTile in csrc/footprint.h
_SPLAT = 16  # floats, sizeof(Splat) in csrc/formulas.h
SLACK = 0.05  # of a distance, which own Gaussians may move without compositing in a wrong order
FAINT = 1 / 255  # summed weight in a tile's pixels, up to which a splat is not composited among own Gaussians


@dataclass(frozen=True, eq=False)
class Baked:
    """One camera's exterior: M splats, and layers of A of the T tiles of its image."""

    splats: Tensor  # (16 M,) float32, those among the own Gaussians
    rays: Tensor  # (16 M,) float32; (0,) with affine projection
    places: Tensor  # (T,) int32, the row of a tile in the layers, -1 where it is not active
    spans: Tensor  # (T, 2) float32, world units: distances between which the splats composite
    fronts: Tensor  # (F,) int64, the rows of the layers where there is something in front
    front: Tensor  # (F, 5, 16, 16) float16: transmittance, r, g, b, inverse depth times `unit`
    back: Tensor  # (A, 5, 16, 16) the same, what is behind all others
    unit: float  # world units

    def tensors(self) -> dict[str, Tensor]:
        """By name."""
        values = {field.name: getattr(self, field.name) for field in fields(self)}
        return {name: value for name, value in values.items() if isinstance(value, Tensor)}

    def to(self, device: str | torch.device) -> "Baked":
        """On a device."""
        return Baked(unit=self.unit, **{name: tensor.to(device) for name, tensor in self.tensors().items()})

    @property
    def nbytes(self) -> int:
        """Bytes of all tensors."""
        return sum(tensor.nbytes for tensor in self.tensors().values())

    def arrays(self) -> list[Tensor]:
        """For `ops.rasterize`."""
        front, back = torch.zeros_like(self.back, dtype=torch.float32), self.back.float()
        front[:, 0].fill_(1)
        front[self.fronts] = self.front.float()
        for layer in (front, back):
            layer[:, 4].div_(self.unit)
        return [self.splats, self.rays, self.places, self.spans, front, back]

    def active(self, width: int, height: int) -> Tensor:
        """(height, width) bool, the pixels of active tiles."""
        rows, columns = -(-height // TILE), -(-width // TILE)
        tiles = (self.places >= 0).view(rows, 1, columns, 1)
        return tiles.expand(rows, TILE, columns, TILE).reshape(rows * TILE, -1)[:height, :width]


def bake(
    gaussians: Gaussians, own: int, camera: Camera, *, near: float, unit: float, sh_degree: int = 3
) -> Baked:
    """What one camera sees of all but the first `own` Gaussians, on the device that these are on.

    Args: camera on the CPU; near in world units; unit in world units, about the least distance of what is
    seen: inverse depths are stored times it. A GPU keeps the host waiting four times: for how many pairs of
    splats and tiles there are, active tiles, tiles with something in front, and splats among the own ones.

    Raises RunError on a GPU where there are more than 2³¹ pairs.
    """
    *images, span, among, splats, rays = ops.bake(
        **{name: tensor.detach() for name, tensor in gaussians.tensors().items()},
        rotation=camera.rotation,
        translation=camera.translation,
        own=own,
        width=camera.width,
        height=camera.height,
        sh_degree=sh_degree,
        near=near,
        exact=gaussians.exact,
        slack=SLACK,
        faint=FAINT,
    )
    active = span[:, 0] <= span[:, 1]
    tiles, rows = active.nonzero()[:, 0], among.nonzero()[:, 0]
    front, back = (_tiles(images[first : first + 3], tiles, unit) for first in (0, 3))
    fronts = ((front[:, :1] != 1) | (front[:, 1:] != 0).any(1, keepdim=True)).flatten(1).any(1)
    fronts = fronts.nonzero()[:, 0]
    return Baked(
        splats=_rows(splats, rows),
        rays=_rows(rays, rows) if gaussians.exact else rays,
        places=torch.where(active, active.cumsum(0) - 1, -1).to(torch.int32),
        spans=span,
        fronts=fronts,
        front=front[fronts],
        back=back,
        unit=unit,
    )


def _rows(splats: Tensor, rows: Tensor) -> Tensor:
    """Some of the splats (16 N,) or their rays."""
    return splats.view(-1, _SPLAT)[rows].flatten()


def _tiles(layer: list[Tensor], chosen: Tensor, unit: float) -> Tensor:
    """Color, alpha and inverse depth of an image as a layer (A, 5, 16, 16) of A chosen tiles."""
    color, alpha, inverse_depth = layer
    height, width = alpha.shape
    planes = torch.stack([1 - alpha, *color.unbind(2), inverse_depth * unit])
    padded = torch.nn.functional.pad(planes, (0, -width % TILE, 0, -height % TILE))
    rows, columns = padded.shape[1] // TILE, padded.shape[2] // TILE
    tiles = padded.view(5, rows, TILE, columns, TILE).permute(1, 3, 0, 2, 4)
    return tiles.reshape(rows * columns, 5, TILE, TILE)[chosen].half()
