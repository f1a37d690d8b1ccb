"""The parts of the ops on CUDA but for the losses: one or a few kernels each, in memory of torch.

A part launches kernels through a `Launch` and does not depend on the card. On a GPU that is
`card.Card.launch`, in the tests an emulation on the host.
"""

import functools
import math
import struct
from collections.abc import Mapping, Sequence
from typing import NamedTuple, Protocol

import torch
from torch import Tensor

from panolog.renderer.adam import BETAS, EPSILON, Moving
from panolog.scene.errors import RunError
from panolog.scene.gaussians import PARAMETERS

TILE = 16  # kTile in csrc/cuda/common.cuh
SPAN = 128  # Gaussians in a block of project.cu
THREADS = 256  # in a block of all other kernels
LANES = 8  # threads that share a splat in bin.cu
SPLAT_FLOATS = 16  # sizeof(Splat) / 4 in csrc/formulas.h, and of RaySplat in csrc/rays.h
SUMS = {"": 10, "_absolute": 12, "_ray": 13}  # k…GradientFloats in csrc, by names of kernels
MAX_PAIRS = 2**31 - 1  # of splats and tiles, counted in int32
NARROW_TILES = 2**16  # below so many their numbers fit int16, which sorts in half the time
NARROW_FIRST = -(2**15)  # the number of the first of them

Argument = Tensor | int | float | bytes | None


class Struct(bytes):
    """A struct by value that points to tensors."""

    tensors: Mapping[str, Tensor]


class Launch(Protocol):
    """Launches kernels of csrc/cuda on one device."""

    def __call__(self, kernel: str, grid: tuple[int, int], block: int, /, **arguments: Argument) -> None:
        """Run a kernel on grid[0] × grid[1] blocks of `block` threads; not at all if there is no block.

        Arguments go by the names of the kernel's parameters. Tensors become pointers to their first element,
        None a null pointer, int int64_t, float float, and bytes a struct by value.
        """


class Rays(NamedTuple):
    """What kernels of exact projection take besides, by the names of their parameters."""

    rays: Tensor  # (16 N,) RaySplat of csrc/rays.h
    azimuths: Tensor  # `half_pixels`
    elevations: Tensor


class Exterior(NamedTuple):
    """What is frozen around the Gaussians, on the device: what `baked.Baked.arrays` lists."""

    splats: Tensor  # (16 M,)
    rays: Tensor  # (16 M,), without exact projection (0,)
    places: Tensor  # (T,) int32
    spans: Tensor  # (T, 2)
    front: Tensor  # (A, 5, 16, 16)
    back: Tensor

    @staticmethod
    def of(arrays: Sequence[Tensor], width: int, height: int, exact: bool) -> "Exterior | None":
        """None without arrays. Raises ValueError if they are not of such a camera."""
        if not arrays:
            return None
        found = Exterior(*(array.contiguous() for array in arrays))
        across, down = tiles_of(width, height)
        if len(found.places) != across * down or len(found.rays) != len(found.splats) * exact:
            raise ValueError("the exterior is not one of this camera")
        return found


class Projected(NamedTuple):
    """N Gaussians on the panorama, and after them the M splats of an exterior."""

    splats: Tensor  # (16 (N + M),)
    rays: Rays | None  # with exact projection
    state: Tensor  # (N,) uint8
    depth: Tensor  # (N + M,) radial distance
    tile_counts: Tensor  # (N + M,) int32, how many tiles each meets


class Pairs(NamedTuple):
    """The splats by tile."""

    entries: Tensor  # (E,) int32 rows of the splats, nearest first within each of the T tiles
    starts: Tensor  # (T + 1,) int32 where those of each tile begin
    counts: Tensor  # (N + M,) int64 running sums of the pairs: the last is how many there are, listed or not


def project(
    launch: Launch,
    parameters: Mapping[str, Tensor],
    screen: Tensor,
    camera: bytes,
    sh_degree: int,
    angles: tuple[Tensor, Tensor] | None = None,
    exterior: Exterior | None = None,
) -> Projected:
    """The projection of N Gaussians, exact with `angles`, by `half_pixels`; `camera` by `camera_struct`."""
    means = parameters["means"]
    count = len(means)
    frozen = 0 if exterior is None else len(exterior.splats) // SPLAT_FLOATS
    splats, depth = means.new_empty((count + frozen) * SPLAT_FLOATS), means.new_empty(count + frozen)
    rays = None if angles is None else Rays(torch.empty_like(splats), *angles)
    state = means.new_empty(count, dtype=torch.uint8)
    tile_counts = means.new_empty(count + frozen, dtype=torch.int32)
    launch(
        "project_forward" if rays is None else "project_ray_forward",
        (math.ceil(count / SPAN), 1),
        SPAN,
        **parameters,
        **({"screen": screen} if rays is None else rays._asdict()),
        camera=camera,
        sh_count=(sh_degree + 1) ** 2,
        count=count,
        splats=splats,
        state=state,
        depth=depth,
        tile_counts=tile_counts,
    )
    if exterior is not None:
        around: dict[str, Argument] = {"around": exterior.splats}
        launch(
            "project_exterior" if rays is None else "project_ray_exterior",
            (math.ceil(frozen / SPAN), 1),
            SPAN,
            **(around if rays is None else around | {"around_rays": exterior.rays} | rays._asdict()),
            camera=camera,
            count=frozen,
            own=count,
            splats=splats,
            depth=depth,
            tile_counts=tile_counts,
        )
    return Projected(splats, rays, state, depth, tile_counts)


def list_pairs(
    launch: Launch,
    projected: Projected,
    width: int,
    height: int,
    room: int | None = None,
    exterior: Exterior | None = None,
) -> Pairs:
    """The pairs of splats and tiles in E = `room` entries; those beyond it are left out.

    Without `room` there is as much as needed, for which the host waits. Sorted by depth first, then stably by
    tile: neither sort needs keys of 64 bits. Pairs that an exterior leaves out take room and are counted, but
    come after all tiles.

    Raises:
        RunError: more than 2³¹ pairs, where the host waits.
    """
    splats, rays, state, depth, tile_counts = projected
    order = torch.sort(depth, stable=True).indices
    ends = torch.cumsum(tile_counts[order], 0)
    if room is None:
        room = int(ends[-1]) if len(ends) else 0
        check_pairs(room)
    across, down = tiles_of(width, height)
    narrow = across * down < NARROW_TILES
    first, dtype = (NARROW_FIRST, torch.int16) if narrow else (0, torch.int32)
    tiles = torch.full((room,), first + across * down, dtype=dtype, device=depth.device)  # after all tiles
    rows = tile_counts.new_empty(room)
    width_of = "narrow" if narrow else "wide"
    launch(
        f"bin_{width_of}" if rays is None else f"bin_ray_{width_of}",
        (math.ceil(len(depth) * LANES / THREADS), 1),
        THREADS,
        splats=splats,
        **({} if rays is None else rays._asdict()),
        order=order,
        ends=ends,
        tile_counts=tile_counts,
        count=len(depth),
        width=width,
        height=height,
        **_of(exterior, "places", "spans"),
        own=len(state),
        room=room,
        tiles=tiles,
        rows=rows,
    )
    tiles, by_tile = torch.sort(tiles, stable=True)
    numbers = _numbers(first, across * down + 1, dtype, depth.device)
    return Pairs(rows[by_tile], torch.searchsorted(tiles, numbers, out_int32=True), ends)


def _of(exterior: Exterior | None, *names: str) -> dict[str, Tensor | None]:
    """What kernels take of it."""
    return {name: None if exterior is None else getattr(exterior, name) for name in names}


def check_pairs(pairs: int) -> None:
    """Raises RunError if there are too many pairs of splats and tiles."""
    if pairs > MAX_PAIRS:
        raise RunError(f"{pairs} pairs of Gaussians and tiles are too many: render fewer Gaussians or pixels")


@functools.lru_cache(maxsize=8)
def _numbers(first: int, count: int, dtype: torch.dtype, device: torch.device) -> Tensor:
    return torch.arange(first, first + count, dtype=dtype, device=device)


@functools.lru_cache(maxsize=8)
def half_pixels(width: int, height: int, device: torch.device) -> tuple[Tensor, Tensor]:
    """Sine and cosine, of the azimuths (2 columns + 1, 2) and elevations (2 rows + 1, 2) of every half pixel.

    Of all pixels of all tiles: odd rows are their centres, even ones the middles of even numbers of pixels.
    """

    def of(tiles: int, half_pixel: float, middle: int) -> Tensor:
        angle = (torch.arange(2 * TILE * tiles + 1, dtype=torch.float64, device=device) - middle) * half_pixel
        return torch.stack([angle.sin(), angle.cos()], 1).float()

    across, down = tiles_of(width, height)
    return of(across, math.pi / width, width), of(down, math.pi / (2 * height), height)


def of_tiles(
    splats: Tensor, rays: Rays | None, entries: Tensor, starts: Tensor, width: int, height: int
) -> dict[str, Argument]:
    """What each kernel of csrc/cuda/composite.cu takes first: a block works on a tile of the image."""
    lists: dict[str, Argument] = {"entries": entries, "starts": starts, "width": width, "height": height}
    return {"splats": splats, **lists} if rays is None else rays._asdict() | lists


def composite(
    launch: Launch,
    splats: Tensor,
    rays: Rays | None,
    pairs: Pairs,
    width: int,
    height: int,
    exterior: Exterior | None = None,
) -> tuple[Tensor, Tensor, Tensor]:
    """Color (H, W, 3), alpha (H, W) and inverse depth (H, W)."""
    color, alpha = splats.new_empty(height, width, 3), splats.new_empty(height, width)
    inverse_depth = torch.empty_like(alpha)
    launch(
        "composite_forward" if rays is None else "composite_ray_forward",
        tiles_of(width, height),
        THREADS,
        **of_tiles(splats, rays, pairs.entries, pairs.starts, width, height),
        **_of(exterior, "places", "front", "back"),
        color=color,
        alpha=alpha,
        inverse_depth=inverse_depth,
    )
    return color, alpha, inverse_depth


def composite_backward(
    launch: Launch,
    splats: Tensor,
    rays: Rays | None,
    entries: Tensor,
    starts: Tensor,
    width: int,
    height: int,
    own: int,
    exterior: Exterior | None = None,
    absolute: bool = False,
    **images: Tensor,
) -> Tensor:
    """(N, 10), with absolute gradients (N, 12) or, exact, (N, 13): gradients of the first N = `own` splats.

    Args: images, contiguous: the three and their gradients.
    """
    kind = "_ray" if rays is not None else "_absolute" if absolute else ""
    sums = splats.new_zeros(own, SUMS[kind])
    launch(
        f"composite{kind}_backward",
        tiles_of(width, height),
        THREADS,
        **of_tiles(splats, rays, entries, starts, width, height),
        **_of(exterior, "places", "front"),
        **images,
        own=own,
        sums=sums,
    )
    return sums


class Frame(NamedTuple):
    """What the backward projection takes besides the model: what was seen, and what the pixels say of it."""

    camera: bytes  # `camera_struct`
    sh_degree: int
    splats: Tensor  # (16 (N + M),)
    tile_counts: Tensor  # (N + M,)
    sums: Tensor  # (N, 10), (N, 12) or (N, 13) by `composite_backward`
    motion: Tensor | None  # (N, 6), receives the parts of the Gaussians in the gradient of the camera's pose

    @property
    def kind(self) -> str:
        """The part of a kernel's name that says for which projection its sums are."""
        (kind,) = (kind for kind, floats in SUMS.items() if floats == self.sums.shape[1])
        return kind

    def screen(self) -> dict[str, Tensor]:
        """Room for the gradients of `screen` and, if summed, `absolute` ones, both (N, 2)."""
        names = ("screen", "absolute")[: 1 + (self.kind == "_absolute")]
        return {name: self.splats.new_empty(len(self.sums), 2) for name in names}

    def launch(self, launch: Launch, kernel: str, out: Mapping[str, Tensor], **arguments: Argument) -> None:
        """Launches the kernel of this projection, a thread for each Gaussian."""
        launch(
            f"project{self.kind}_{kernel}",
            (math.ceil(len(self.sums) / SPAN), 1),
            SPAN,
            camera=self.camera,
            sh_count=(self.sh_degree + 1) ** 2,
            count=len(self.sums),
            splats=self.splats,
            tile_counts=self.tile_counts,
            sums=self.sums,
            **{f"out_{name}": tensor for name, tensor in out.items()},
            out_motion=self.motion,
            **arguments,
        )


def project_backward(launch: Launch, parameters: Mapping[str, Tensor], frame: Frame) -> dict[str, Tensor]:
    """The gradients of the parameters, and those of `Frame.screen`."""
    out = {name: torch.empty_like(tensor) for name, tensor in parameters.items()} | frame.screen()
    frame.launch(launch, "backward", out, **parameters)
    return out


def project_step(
    launch: Launch,
    parameters: Mapping[str, Tensor],
    moving: Mapping[str, Moving],
    step: int,
    frame: Frame,
    status: Tensor,
    broken: Tensor,
) -> dict[str, Tensor]:
    """One step of Adam of a model, in place, by gradients that are never in memory; those of `Frame.screen`.

    Args: moving, of the model's parameters those that move; step, 1 for the first one; status (1,) int32, no
    step unless it is 0; broken (1,) int32, receives kBrokenGradient of what is not finite: the model is then
    invalid.
    """
    packed, pointed = b"", dict(parameters)
    for name in PARAMETERS:
        found = moving.get(name)
        if found is None:
            packed += _MOVING.pack(parameters[name].data_ptr(), 0, 0, 0, 0, 0.0)
            continue
        needed = {"exp_avg": found.exp_avg, "exp_avg_sq": found.exp_avg_sq, "units": found.units}
        pointers = (0 if it is None else it.data_ptr() for it in (parameters[name], *needed.values()))
        packed += _MOVING.pack(*pointers, found.values, found.lr / (1 - BETAS[0] ** step))
        pointed |= {f"{what} of {name}": it for what, it in needed.items() if it is not None}
    given = Struct(packed + _CONSTANTS.pack(1 / math.sqrt(1 - BETAS[1] ** step), *BETAS, EPSILON))
    given.tensors = pointed
    out = frame.screen()
    frame.launch(launch, "step", out, step=given, status=status, broken=broken)
    return out


_MOVING, _CONSTANTS = struct.Struct("=4Qqf4x"), struct.Struct("=4f")  # Moving and Step in csrc/cuda/adam.cuh


def camera_struct(
    rotation: Tensor, translation: Tensor, width: int, height: int, near: float, exact: bool
) -> bytes:
    """`Camera` of csrc/formulas.h; rotation (3, 3) and translation (3,) float32 on the CPU."""
    pose = rotation.numpy().tobytes() + translation.numpy().tobytes()
    return pose + struct.pack("=iifi", width, height, near, exact)


def contiguous(**tensors: Tensor) -> dict[str, Tensor]:
    return {name: tensor.contiguous() for name, tensor in tensors.items()}


def tiles_of(width: int, height: int) -> tuple[int, int]:
    """Tiles across and down."""
    return math.ceil(width / TILE), math.ceil(height / TILE)
