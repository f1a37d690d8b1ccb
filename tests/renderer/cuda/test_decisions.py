"""CUDA counts the same pairs of pixels and splats as the CPU, also where a splat is not finite."""

import ctypes
import functools
import math
import os
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from panolog.renderer.cuda import parts
from panolog.renderer.cuda.nvrtc import CSRC
from tests.renderer.cuda.emulation import EmulatedLaunch

pytestmark = pytest.mark.system

WIDTH, HEIGHT, TILES, SPLATS = 64, 16, 4, 3
# Of Splat, in their order. The bounds of the footprint, which follow, only save work.
FIELDS = ("u", "v", "a", "slope", "c", "log2_opacity", "red", "green", "blue", "inverse_depth")

# One tile after the other as rasterize.cpp does, but with splats that no Gaussian has.
CPU = """
#define PANOLOG_ISA portable
#include "tile.cpp"
using namespace panolog;

extern "C" void render(const Splat* splats, int count, int width, int tiles, float* color, float* alpha,
                       float* inverse_depth, const float* grad_color, const float* grad_alpha,
                       const float* grad_inverse_depth, SplatGradient* parts) {
  for (int tile = 0; tile < tiles; ++tile) {
    Entry entries[16];
    for (int i = 0; i < count; ++i) entries[i] = {uint32_t(i), uint32_t(tile * count + i), 0};
    TileInput in = {splats, nullptr, {}, {}, entries, entries + count};
    in.x0 = tile * kTile, in.width = width, in.height = kTile;
    const Images images = {color, alpha, inverse_depth};
    portable::tile_forward(in, images);
    portable::tile_backward(in, images, {grad_color, grad_alpha, grad_inverse_depth}, parts);
  }
}
"""


@functools.cache
def cpu(folder: Path) -> ctypes.CDLL:
    """tile.cpp for any processor."""
    compiler = os.environ.get("CXX") or next(filter(shutil.which, ("c++", "g++", "clang++")), None)
    if compiler is None:
        pytest.skip("there is no C++ compiler")
    source, library = folder / "cpu.cpp", folder / "cpu.so"
    source.write_text(CPU)
    command = [compiler, "-std=c++17", "-O1", "-w", "-fPIC", "-shared", f"-I{CSRC}", str(source)]
    subprocess.run([*command, "-o", str(library)], check=True)
    return ctypes.CDLL(str(library))


def three_splats() -> Tensor:
    """(3, 16) splats that cover the whole panorama, each brighter than 1/255 everywhere."""
    shape = [-0.003, 0.2, -0.004, -1.0]
    rows = [
        [30.2 + 3 * i, 7.7, *shape, 0.3, 0.6, 0.9, 0.5, 2.0 + i, 0.0, 200.0, 0.0, 200.0, 200.0]
        for i in range(3)
    ]
    return torch.tensor(rows)


def on_the_cpu(splats: Tensor, gradients: list[Tensor], folder: Path) -> list[Tensor]:
    """Color, alpha, inverse depth and the sums (3, 10) over pixels."""
    images = [torch.empty(HEIGHT, WIDTH, 3), torch.empty(HEIGHT, WIDTH), torch.empty(HEIGHT, WIDTH)]
    sums = torch.empty(TILES, SPLATS, 10)
    aligned = np.empty(SPLATS * 16 + 16, np.float32)  # a splat is one line of the cache
    start = -aligned.ctypes.data % 64 // 4
    aligned[start : start + SPLATS * 16] = splats.numpy().ravel()
    pointers = [ctypes.c_void_p(each.data_ptr()) for each in (*images, *gradients, sums)]
    cpu(folder).render(ctypes.c_void_p(aligned[start:].ctypes.data), SPLATS, WIDTH, TILES, *pointers)
    return [*images, sums.sum(0)]


def on_cuda(splats: Tensor, gradients: list[Tensor]) -> list[Tensor]:
    """The same by the emulated kernels."""
    launch = EmulatedLaunch()
    entries = torch.arange(SPLATS, dtype=torch.int32).repeat(TILES)
    starts = torch.arange(TILES + 1, dtype=torch.int32) * SPLATS
    pairs = parts.Pairs(entries, starts, torch.empty(0))
    images = parts.composite(launch, splats.ravel(), None, pairs, WIDTH, HEIGHT)
    names = ("color", "alpha", "inverse_depth")
    given = dict(zip(names, images, strict=True))
    given |= {f"grad_{name}": grad for name, grad in zip(names, gradients, strict=True)}
    return [
        *images,
        parts.composite_backward(
            launch, splats.ravel(), None, entries, starts, WIDTH, HEIGHT, SPLATS, None, **given
        ),
    ]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("cpu")


@pytest.mark.parametrize("value", [0.0, math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("field", FIELDS)
def test_a_splat_with_one_field_that_is_not_finite(field: str, value: float, folder: Path) -> None:
    splats = three_splats()
    splats[1, FIELDS.index(field)] = value
    rng = torch.Generator().manual_seed(0)
    shapes = ((HEIGHT, WIDTH, 3), (HEIGHT, WIDTH), (HEIGHT, WIDTH))
    gradients = [torch.randn(shape, generator=rng) for shape in shapes]
    truth, ours = on_the_cpu(splats, gradients, folder), on_cuda(splats, gradients)
    for name, one, two in zip(("color", "alpha", "inverse depth", "sums"), ours, truth, strict=True):
        assert torch.allclose(one, two, rtol=1e-3, atol=1e-4, equal_nan=True), name
    assert ours[1].isfinite().all()
    bright = field in FIELDS[6:] or value == 0 or (value == math.inf and field in ("a", "c", "log2_opacity"))
    assert bool(ours[3][1].any()) == bright  # what is not a number is opaque nowhere
