"""What the images of a SOG hold, from Gaussians that are read in pieces: 19 bytes of each stay in memory.

Facts from https://developer.playcanvas.com/user-manual/gaussian-splatting/formats/sog: positions are 16-bit
between the bounds of sign(x)·log(1 + |x|); scales (log) and SH of degree 0 are entries of codebooks; of a
quaternion the three smallest components have 8 bits between ±√½; opacity has 8 bits, linear; SH of higher
degrees are rows of a palette. The source is read twice: to survey it, then to quantise it.
"""

import math
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, Future
from dataclasses import dataclass, field
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from panolog.export.order import morton_order, places_in
from panolog.export.sog.codebook import Histogram, nearest
from panolog.export.sog.palette import Palette, make_palette, palette_size, sample_size, step_of, units
from panolog.export.splats import KEPT, REST, Splats, SplatSource, with_rows

Bytes = NDArray[np.uint8]
Floats = NDArray[np.float32]
Doubles = NDArray[np.float64]
T = TypeVar("T")

COLUMNS = 64  # entries of the palette in a row of its image
_LEVELS = 65_535  # of a position
_UNIT = 16.0  # the integer weight of a usual Gaussian in the palette
_AHEAD = 2  # pieces in work besides the one that is read
_LOGARITHM = 30.0  # at most, so that exp is finite in float32
_CHANNELS = {"means_l": 3, "means_u": 3, "scales": 3, "quats": 4, "sh0": 4}  # images of any model


@dataclass(eq=False)
class Layers:
    """The pixels of each image by name (H · W, channels), and what decodes them."""

    count: int
    width: int
    mins: Doubles  # (3,) of sign(x)·log(1 + |x|)
    maxs: Doubles  # (3,)
    scales: Floats  # (256,) codebook
    sh0: Floats  # (256,) codebook
    pixels: dict[str, Bytes]
    palette: "PaletteImage | None" = None  # of SH beyond degree 0


@dataclass(frozen=True, eq=False)
class PaletteImage:
    """The palette as it is stored."""

    count: int
    degree: int
    codebook: Floats  # (256,)
    pixels: Bytes  # (rows, 64 · K, 3), where K are the coefficients of a channel


@dataclass(eq=False)
class _Survey:
    """What has to be known of all Gaussians before one is quantised."""

    means: Floats  # (N, 3)
    scales: Histogram = field(default_factory=Histogram)
    sh0: Histogram = field(default_factory=Histogram)
    sample: list[Floats] = field(default_factory=list)  # of SH beyond degree 0: (S, D) in parts
    importance: list[Floats] = field(default_factory=list)  # (S,) in parts


def make_layers(source: SplatSource, pool: Executor, *, sort: bool = True) -> Layers:
    """Quantises all Gaussians, in Morton order or, without `sort`, in the order of the source.

    Args: source, at least one Gaussian, all finite; pool, threads: their number does not change a byte.
    """
    survey = _survey(source, pool)
    count = source.count
    low, high = _compressed(survey.means.min(axis=0)), _compressed(survey.means.max(axis=0))
    places = places_in(morton_order(survey.means) if sort else np.arange(count))
    survey.means = survey.means[:0]
    usual, palette = _trained(survey, palette_size(count), pool) if source.degree else (1.0, None)
    width = -(-(math.isqrt(count - 1) + 1) // 4) * 4  # the root, rounded up to a multiple of 4
    size = width * (-(-count // (4 * width)) * 4)
    channels = _CHANNELS | ({"shN_labels": 3} if source.degree else {})
    pixels = {name: np.zeros((size, number), np.uint8) for name, number in channels.items()}
    layers = Layers(count, width, low, high, survey.scales.codebook(), survey.sh0.codebook(), pixels)
    del survey

    def quantise(rows: slice, piece: Splats) -> None:
        _quantise(piece, places[rows], layers)
        if palette is not None:
            pixels["shN_labels"][places[rows], :2] = _label(piece, palette, usual)

    for _ in _mapped(source, pool, quantise):
        pass
    layers.palette = None if palette is None else _palette_image(palette, source.degree)
    return layers


def _mapped(
    source: SplatSource, pool: Executor, task: Callable[[slice, Splats], T]
) -> Iterator[tuple[slice, Splats, T]]:
    """Each piece, its rows, and what the task returns for these, in order."""
    waiting: deque[tuple[slice, Splats, Future[T]]] = deque()
    for rows, piece in with_rows(source):
        waiting.append((rows, piece, pool.submit(task, rows, piece)))
        if len(waiting) > _AHEAD:
            at, first, found = waiting.popleft()
            yield at, first, found.result()
    for at, first, found in waiting:
        yield at, first, found.result()


def _survey(source: SplatSource, pool: Executor) -> _Survey:
    """One pass over the source."""
    survey = _Survey(np.empty((source.count, 3), np.float32))
    stride = max(1, source.count // sample_size(source.count))

    def look(rows: slice, piece: Splats) -> tuple[Histogram, Histogram]:
        survey.means[rows] = piece.means
        return Histogram.of(piece.scales), Histogram.of(piece.sh0)

    for rows, piece, (scales, sh0) in _mapped(source, pool, look):
        survey.scales.add(scales)
        survey.sh0.add(sh0)
        if source.degree:
            some = piece.select(slice(-rows.start % stride, None, stride))
            survey.sample.append(np.array(some.shN.reshape(len(some), -1)))
            survey.importance.append(_importance(some))
    return survey


def _trained(survey: _Survey, size: int, pool: Executor) -> tuple[float, Palette]:
    """The usual importance of a Gaussian, and a palette for the sample, which is then forgotten."""
    importance = np.concatenate(survey.importance)
    usual = float(np.median(importance)) or 1.0
    sample = np.concatenate(survey.sample)
    survey.sample.clear()
    step = step_of(sample)
    sample = units(sample, step)
    return usual, make_palette(sample, step, _weights(importance, usual), size, pool)


def _importance(splats: Splats) -> Floats:
    """(N,) opacity times size: what a Gaussian adds to images, of which most are seen from nearby."""
    size = splats.scales.mean(axis=1).clip(-_LOGARITHM, _LOGARITHM)
    return np.asarray(_alpha(splats.opacities) * np.exp(size), np.float32)


def _weights(importance: Floats, usual: float) -> Floats:
    """(N,) as integers, of which sums are exact."""
    return np.asarray(np.rint(importance * np.float32(_UNIT / usual)).clip(1, 65_535), np.float32)


def _quantise(piece: Splats, rows: NDArray[np.int32], layers: Layers) -> None:
    """Writes all but labels of a piece to its rows."""
    spans = layers.maxs - layers.mins
    shares = (_compressed(piece.means) - layers.mins) / np.where(spans > 0, spans, 1)
    levels = np.rint(shares * _LEVELS).astype(np.uint16)
    layers.pixels["means_l"][rows] = levels & 255
    layers.pixels["means_u"][rows] = levels >> 8
    layers.pixels["scales"][rows] = nearest(layers.scales, piece.scales)
    layers.pixels["quats"][rows] = _quantised_quats(piece.quats)
    alpha = np.rint(_alpha(piece.opacities) * 255)
    layers.pixels["sh0"][rows] = np.column_stack([nearest(layers.sh0, piece.sh0), alpha.astype(np.uint8)])


def _label(piece: Splats, palette: Palette, usual: float) -> Bytes:
    """(N, 2) low and high byte of the entry of each, which is added to the entry's sum."""
    vectors = units(piece.shN.reshape(len(piece), -1), palette.step)
    labels = palette.labels(vectors)
    palette.add(vectors, labels, _weights(_importance(piece), usual))
    return labels.astype("<u2").view(np.uint8).reshape(-1, 2)


def _compressed(values: NDArray[np.float32]) -> Doubles:
    """sign(x)·log(1 + |x|): fine near the origin, coarse far away."""
    wide = values.astype(np.float64)
    return np.asarray(np.copysign(np.log1p(np.abs(wide)), wide))


def _alpha(logits: Floats) -> Floats:
    return np.asarray(1 / (1 + np.exp(-logits.clip(-_LOGARITHM, _LOGARITHM))), np.float32)


def _quantised_quats(quats: Floats) -> Bytes:
    """(N, 4) the three smallest components of quaternions (N, 4), then 252 + which one is left out."""
    row, largest = np.arange(len(quats)), np.abs(quats).argmax(axis=1)
    signed = np.where(quats[row, largest, None] < 0, -quats, quats)
    kept = np.take_along_axis(signed, KEPT[largest], axis=1)
    levels = np.rint((kept * np.float32(0.5**0.5) + np.float32(0.5)) * 255).clip(0, 255)
    return np.column_stack([levels, 252 + largest]).astype(np.uint8)


def _palette_image(palette: Palette, degree: int) -> PaletteImage:
    """The means of the entries, by a codebook."""
    means = (palette.means() * palette.step).astype(np.float32)
    each = np.broadcast_to(palette.weights[:, None].clip(1), means.shape)
    codebook = Histogram.of(means, each).codebook()
    rows = -(-len(means) // COLUMNS)
    pixels = np.zeros((rows * COLUMNS, means.shape[1]), np.uint8)
    pixels[: len(means)] = nearest(codebook, means)
    return PaletteImage(len(means), degree, codebook, pixels.reshape(rows, COLUMNS * REST[degree], 3))
