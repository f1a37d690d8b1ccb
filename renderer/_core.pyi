"""The compiled kernels, argument by argument as in csrc/bindings.cpp; a test compares both."""

import collections.abc

import numpy as np
from numpy.typing import NDArray

Bytes = NDArray[np.uint8]
Floats = NDArray[np.float32]
Doubles = NDArray[np.float64]
Ints = NDArray[np.int32]

# fmt: off
def instruction_set() -> str: ...
def choose_instruction_set(name: str) -> bool: ...
def keep_memory() -> None: ...
def release_memory() -> None: ...
def rasterize(
    means: Floats, quats: Floats, scales: Floats, opacities: Floats, sh0: Floats, shN: Floats, screen: Floats,
    rotation: Floats, translation: Floats, width: int, height: int, sh_degree: int, near: float, exact: bool,
    threads: int, color: Floats, alpha: Floats, inverse_depth: Floats, state: Bytes,
    exterior: tuple[Floats, Floats, Ints, Floats, Floats, Floats] | None,
) -> tuple[Floats, Floats, Ints, Ints, Ints]: ...
def rasterize_backward(
    means: Floats, quats: Floats, scales: Floats, opacities: Floats, sh0: Floats, shN: Floats, screen: Floats,
    rotation: Floats, translation: Floats, width: int, height: int, sh_degree: int, near: float, exact: bool,
    threads: int, color: Floats, alpha: Floats, inverse_depth: Floats, splats: Floats, rays: Floats,
    slots: Ints, entries: Ints, tiles: Ints, grad_color: Floats, grad_alpha: Floats,
    grad_inverse_depth: Floats, exterior: tuple[Floats, Floats, Ints, Floats, Floats, Floats] | None,
    out: collections.abc.Sequence[Floats] | None = None, out_screen: Floats | None = None,
    out_motion: Doubles | None = None, out_absolute: Floats | None = None,
    step: tuple[
        collections.abc.Sequence[tuple[Floats, Floats, Floats, int, float, Floats | None] | None],
        float, float, float, int,
    ] | None = None,
) -> int: ...
def bake(
    means: Floats, quats: Floats, scales: Floats, opacities: Floats, sh0: Floats, shN: Floats, screen: Floats,
    own: int, rotation: Floats, translation: Floats, width: int, height: int, sh_degree: int, near: float,
    exact: bool, slack: float, faint: float, threads: int, front_color: Floats, front_alpha: Floats,
    front_inverse_depth: Floats, back_color: Floats, back_alpha: Floats, back_inverse_depth: Floats,
) -> tuple[Floats, Bytes, Floats, Floats]: ...
def photometric(
    color: Floats, target: Bytes, mask: Bytes | None, width: int, height: int, lambda_ssim: float,
    threads: int, gradient: Floats, rows: Floats | None = None, exposure: Floats | None = None,
    normal: Doubles | None = None,
) -> tuple[float, float, float]: ...
def ssim_map(a: Floats, b: Floats, width: int, height: int, threads: int, out: Floats) -> None: ...
def absolute_difference(
    rendered: Floats, target: Floats, valid: Bytes, threads: int, gradient: Floats,
) -> float: ...
def stages() -> tuple[float, float, float, float, float]: ...
