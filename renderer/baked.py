"""The frozen exterior of a block, baked for one camera: what an iteration needs of it (csrc/bake.h).

Own Gaussians lie along a ray between what is before and what is behind them. Both are composited once. What
lies among them stays a list of splats, and tiles in which no own Gaussian can be seen are left out.
"""

from dataclasses import dataclass, fields

import torch
from torch import Tensor

from panolog.renderer import _core, ops
from panolog.renderer.camera import Camera
from panolog.scene.gaussians import Gaussians

TILE = 16  # pixels, kTile in csrc/footprint.h
_CLEAR = (1, 0, 0, 0, 0)  # a pixel of a layer in which there is nothing
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
    """What one camera sees of all but the first `own` Gaussians.

    Args: gaussians on the CPU; near in world units; unit in world units, about the least distance of what is
    seen: inverse depths are stored times it.
    """
    height, width = camera.height, camera.width
    layers = [
        [torch.zeros(height, width, 3), torch.zeros(height, width), torch.zeros(height, width)] for _ in "fb"
    ]
    front, back = ([tensor.numpy() for tensor in layer] for layer in layers)
    spans, among, splats, rays = _core.bake(
        **{name: tensor.detach().contiguous().numpy() for name, tensor in gaussians.tensors().items()},
        screen=torch.zeros(len(gaussians), 2).numpy(),
        own=own,
        rotation=camera.rotation.numpy(),
        translation=camera.translation.numpy(),
        width=width,
        height=height,
        sh_degree=sh_degree,
        near=near,
        exact=gaussians.exact,
        slack=SLACK,
        faint=FAINT,
        threads=ops.threads(),
        **dict(zip(("front_color", "front_alpha", "front_inverse_depth"), front, strict=True)),
        **dict(zip(("back_color", "back_alpha", "back_inverse_depth"), back, strict=True)),
    )
    rows = torch.from_numpy(among).nonzero()[:, 0]
    chosen = [torch.from_numpy(array).view(-1, _SPLAT) for array in (splats, rays)]
    span = torch.from_numpy(spans).view(-1, 2)
    active = span[:, 0] <= span[:, 1]
    chosen = [array[rows].flatten() if len(array) else array.flatten() for array in chosen]
    before = _tiles(layers[0], active, unit)
    fronts = (before != before.new_tensor(_CLEAR).view(5, 1, 1)).flatten(1).any(1).nonzero()[:, 0]
    return Baked(
        splats=chosen[0],
        rays=chosen[1],
        places=torch.where(active, active.cumsum(0) - 1, -1).to(torch.int32),
        spans=span,
        fronts=fronts,
        front=before[fronts],
        back=_tiles(layers[1], active, unit),
        unit=unit,
    )


def _tiles(layer: list[Tensor], active: Tensor, unit: float) -> Tensor:
    """Color, alpha and inverse depth of an image as the layer (A, 5, 16, 16) of its active tiles."""
    color, alpha, inverse_depth = layer
    height, width = alpha.shape
    planes = torch.stack([1 - alpha, *color.unbind(2), inverse_depth * unit])
    padded = torch.nn.functional.pad(planes, (0, -width % TILE, 0, -height % TILE))
    rows, columns = padded.shape[1] // TILE, padded.shape[2] // TILE
    tiles = padded.view(5, rows, TILE, columns, TILE).permute(1, 3, 0, 2, 4)
    return tiles.reshape(rows * columns, 5, TILE, TILE)[active].half()
