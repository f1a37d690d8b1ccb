"""Repeatable randomness for surfaces: a tileable cloud texture and a hash of integer cells."""

import functools
from typing import Any

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.floating[Any]]  # float32 in bulk
SIZE = 512  # texels of the tileable texture, each way: a power of two


@functools.lru_cache(maxsize=1)
def _texture() -> Floats:
    """(SIZE, SIZE) tileable 1/f noise in [0, 1], mean 0.5: white noise filtered in the frequency domain."""
    white = np.random.default_rng(20_26).standard_normal((SIZE, SIZE))
    frequency = np.hypot(np.fft.fftfreq(SIZE)[:, None], np.fft.rfftfreq(SIZE)[None, :]) * SIZE
    pink = np.fft.irfft2(np.fft.rfft2(white) / np.maximum(frequency, 1.0) ** 1.35, s=(SIZE, SIZE))
    texture: Floats = np.clip(0.5 + 0.22 * (pink - pink.mean()) / pink.std(), 0, 1).astype(np.float32)
    return texture


def fractal(u: Floats, v: Floats, period: float) -> Floats:
    """Smooth fractal noise in [0, 1] of positions u, v (N,); it repeats after `period` units each way."""
    texture = _texture()
    x, y = u * np.float32(SIZE / period), v * np.float32(SIZE / period)
    column, row = np.floor(x), np.floor(y)
    fx, fy = x - column, y - row
    left, top = column.astype(np.int32) & (SIZE - 1), row.astype(np.int32) & (SIZE - 1)
    right, bottom = (left + 1) & (SIZE - 1), (top + 1) & (SIZE - 1)
    upper = texture[top, left] * (1 - fx) + texture[top, right] * fx
    lower = texture[bottom, left] * (1 - fx) + texture[bottom, right] * fx
    value: Floats = upper * (1 - fy) + lower * fy
    return value


def cell(u: Floats, v: Floats, salt: int = 0) -> Floats:
    """A random number in [0, 1) for each integer cell floor(u), floor(v) (N,): a brick, a tile, a slab."""
    a = np.floor(u).astype(np.int32).astype(np.uint32)
    b = np.floor(v).astype(np.int32).astype(np.uint32)
    mixed = a * np.uint32(0x9E3779B1) ^ (b + np.uint32(salt)) * np.uint32(0x85EBCA77)
    mixed = (mixed ^ (mixed >> np.uint32(15))) * np.uint32(0x2C1B3C6D)
    mixed = (mixed ^ (mixed >> np.uint32(12))) * np.uint32(0x297A2D39)
    value: Floats = (mixed >> np.uint32(8)).astype(np.float32) / np.float32(1 << 24)
    return value
