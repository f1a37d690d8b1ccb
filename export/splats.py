"""Gaussians to export, as columns of numbers: read in pieces, selected and turned, with bounded memory."""

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Literal, Protocol

import numpy as np
import scipy
import torch
from numpy.typing import NDArray

from panolog.export.frame import Frame
from panolog.scene.gaussians import SH_REST, Gaussians
from panolog.scene.ply import read_ply_chunks

Floats = NDArray[np.float32]
Part = Literal["scene", "sky", "all"]

REST = (0, 3, 8, SH_REST)  # coefficients of one channel beyond degree 0, by degree
ROWS = 65_536  # of a piece
KEPT = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])  # components of four, by which is left out
_INSIDE = 0.999  # of a reach, which a model that was larger has
_SKY = 20.0  # times as far as the scene reaches: viewers sort by 16 bits of the largest distance
_LIMIT = (
    30.0  # of logarithms, so that an opacity of 1 and a size of 0, as other trainers have them, are finite
)


@dataclass(frozen=True, eq=False)
class Splats:
    """N Gaussians in the parameterisation of 3DGS."""

    means: Floats  # (N, 3) world units
    quats: Floats  # (N, 4) w x y z, unit
    scales: Floats  # (N, 3) log of world units
    opacities: Floats  # (N,) logit
    sh0: Floats  # (N, 3) spherical harmonics of degree 0
    shN: Floats  # (N, K, 3) of the degrees beyond, K of `REST`  # noqa: N815

    def __len__(self) -> int:
        return len(self.means)

    @property
    def degree(self) -> int:
        """The degree of the spherical harmonics."""
        return REST.index(self.shN.shape[1])

    def columns(self) -> dict[str, Floats]:
        """The arrays by name."""
        return {item.name: getattr(self, item.name) for item in fields(self)}

    def select(self, rows: NDArray[np.bool_] | NDArray[np.integer] | slice) -> "Splats":
        """Some of them."""
        return Splats(**{name: column[rows] for name, column in self.columns().items()})

    @staticmethod
    def of(gaussians: Gaussians) -> "Splats":
        """Splats with unit quaternions (the identity for zeros, NaN if not finite), and finite logarithms."""
        found = {name: tensor.detach().cpu().numpy() for name, tensor in gaussians.tensors().items()}
        wide = found["quats"].astype(np.float64)  # whose squares neither overflow nor vanish
        lengths = np.linalg.norm(wide, axis=1, keepdims=True)
        lengths[~np.isfinite(lengths)] = np.nan
        quats = np.where(lengths == 0, np.array([1.0, 0, 0, 0]), wide / np.where(lengths == 0, 1, lengths))
        return Splats(
            means=found["means"],
            quats=quats.astype(np.float32),
            scales=found["scales"].clip(-_LIMIT, _LIMIT),
            opacities=found["opacities"].clip(-_LIMIT, _LIMIT),
            sh0=found["sh0"][:, 0],
            shN=found["shN"],
        )

    def turned(self, frame: Frame) -> "Splats":
        """These Gaussians in another frame."""
        means, quats, rest = frame.turn(self.means, self.quats, self.shN)
        return replace(self, means=means, quats=quats, shN=rest)

    def scaled(self, factor: float) -> "Splats":
        """These Gaussians, `factor` times as large, around the origin."""
        if factor == 1:
            return self
        grown = np.float32(np.log(factor))
        return replace(self, means=self.means * np.float32(factor), scales=self.scales + grown)

    def reduced(self, degree: int) -> "Splats":
        """These Gaussians with spherical harmonics of at most a degree."""
        return replace(self, shN=self.shN[:, : REST[degree]])

    def gaussians(self, *, exact: bool = False) -> Gaussians:
        """These Gaussians as a model without sky. Args: exact, `Gaussians.exact`."""
        rest = np.zeros((len(self), SH_REST, 3), np.float32)
        rest[:, : self.shN.shape[1]] = self.shN
        columns = self.columns() | {"sh0": self.sh0[:, None], "shN": rest}
        tensors = {name: torch.from_numpy(np.ascontiguousarray(column)) for name, column in columns.items()}
        return Gaussians(**tensors, sky=0, exact=exact)

    @staticmethod
    def made(count: int, degree: int, part: Callable[[slice], Mapping[str, NDArray[Any]]]) -> "Splats":
        """Makes `count` Gaussians, `ROWS` at a time, so that little more than they needs memory.

        Args: degree, of the spherical harmonics; part, the columns of some rows, by name.
        """
        shapes = {"means": (3,), "quats": (4,), "scales": (3,), "opacities": (), "sh0": (3,)}
        whole = {
            name: np.empty((count, *shape), np.float32)
            for name, shape in {**shapes, "shN": (REST[degree], 3)}.items()
        }
        for rows in (slice(start, min(start + ROWS, count)) for start in range(0, count, ROWS)):
            for name, column in part(rows).items():
                whole[name][rows] = column
        return Splats(**whole)

    @staticmethod
    def joined(parts: "list[Splats]") -> "Splats":
        """The Gaussians of all parts, at least one, in order."""
        columns = [part.columns() for part in parts]
        return Splats(**{name: np.concatenate([column[name] for column in columns]) for name in columns[0]})


class SplatSource(Protocol):
    """Gaussians that can be read in pieces, in the same order each time."""

    @property
    def count(self) -> int:
        """How many there are."""
        ...

    @property
    def degree(self) -> int:
        """The degree of the spherical harmonics."""
        ...

    def pieces(self) -> Iterator[Splats]:
        """The Gaussians, `ROWS` or fewer at a time."""
        ...


def with_rows(source: SplatSource) -> Iterator[tuple[slice, Splats]]:
    """Each piece of a source, with its rows among all Gaussians. Raises what reading the source does."""
    start = 0
    for piece in source.pieces():
        yield slice(start, start + len(piece)), piece
        start += len(piece)


@dataclass(frozen=True, eq=False)
class InMemory:
    """A source of Gaussians that are in memory."""

    splats: Splats

    @property
    def count(self) -> int:
        return len(self.splats)

    @property
    def degree(self) -> int:
        return self.splats.degree

    def pieces(self) -> Iterator[Splats]:
        for start in range(0, len(self.splats), ROWS):
            yield self.splats.select(slice(start, start + ROWS))


@dataclass(frozen=True, eq=False)
class Surroundings:
    """What is within a distance of the nearest of some places, such as cameras."""

    places: NDArray[np.float64]  # (C, 3) in the model's coordinates
    distance: float  # units of the model

    @cached_property
    def _tree(self) -> scipy.spatial.KDTree:
        return scipy.spatial.KDTree(self.places)

    def contain(self, means: Floats) -> NDArray[np.bool_]:
        """(N,) whether places (N, 3) are so near."""
        distances, _ = self._tree.query(means, distance_upper_bound=self.distance)
        return np.asarray(np.isfinite(distances))


@dataclass(frozen=True)
class Selection:
    """Which Gaussians of a model are exported, and how much of them."""

    part: Part = "scene"
    degree: int = 3  # of the spherical harmonics, at most
    min_opacity: float = 0.0  # in [0, 1]; the sky is not subject to it
    max_size: float | None = None  # units of the model, of the longest standard deviation; nor to this
    # lower and upper corner in the model's coordinates, of what is scene; None = everything
    crop: tuple[tuple[float, float, float], tuple[float, float, float]] | None = None
    near: tuple[Surroundings, ...] = ()  # likewise, what is in all of them

    def keeps(self, piece: Splats, scene: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """(N,) which of these are exported; what is not finite never is, because no format can hold it.

        Args: scene (N,), which of them are not sky.
        """
        flat = [column.reshape(len(piece), -1) for column in piece.columns().values()]
        keep = np.all([np.isfinite(values).all(1) for values in flat], axis=0)
        if self.min_opacity > 0:
            keep &= ~scene | (piece.opacities >= np.log(self.min_opacity / (1 - self.min_opacity)))
        if self.max_size is not None:
            keep &= ~scene | (piece.scales.max(1) <= np.log(self.max_size))
        if self.crop is not None:
            lower, upper = np.array(self.crop, np.float32)
            keep &= ~scene | ((piece.means >= lower) & (piece.means < upper)).all(1)
        for surroundings in self.near:
            keep &= ~scene | surroundings.contain(piece.means)
        return np.asarray(keep & {"scene": scene, "sky": ~scene, "all": True}[self.part])


@dataclass(frozen=True)
class Ball:
    """What is scaled around a centre, in the coordinates of a model."""

    center: tuple[float, float, float]
    factor: float

    def of(self, splats: Splats) -> Splats:
        """Splats, so many times as far from the centre and as large: from there they look the same."""
        center = np.array(self.center, np.float32)
        return replace(
            splats,
            means=center + (splats.means - center) * np.float32(self.factor),
            scales=splats.scales + np.float32(np.log(self.factor)),
        )


@dataclass(frozen=True, eq=False)
class ModelSource:
    """What is selected of a model in a PLY of this program or of other trainers, in an exported frame."""

    path: Path
    selection: Selection = field(default_factory=Selection)
    frame: Frame = field(default_factory=Frame)
    scale: float = 1.0  # exported units, such as metres, of one of the model
    sky: Ball | None = None  # where the sky is moved, in the coordinates of the model; None = where it is
    count: int = field(init=False)

    def __post_init__(self) -> None:
        """Counts what is selected. Raises PlyError if the file is no model, or truncated."""
        object.__setattr__(self, "count", sum(map(len, self._selected())))

    @property
    def degree(self) -> int:
        return self.selection.degree

    def part(self, part: Part) -> "ModelSource":
        """This source with another part of its model, by the same choice and in the same frame."""
        return replace(self, selection=replace(self.selection, part=part))

    def with_near_sky(self) -> "ModelSource":
        """This model for viewers: its sky is at most `_SKY` times as far as its scene reaches.

        From the middle of the sky the model looks the same; as one walks, clouds move.
        Raises PlyError if the file has changed meanwhile.
        """
        sky = [piece.means for piece in self.part("sky")._selected()]
        if not sky:
            return self
        center = np.concatenate(sky).mean(axis=0)

        def farthest(parts: Iterable[Floats]) -> float:
            return max((float(np.linalg.norm(part - center, axis=1).max()) for part in parts), default=0.0)

        reach = _SKY * farthest(piece.means for piece in self.part("scene")._selected())
        far = farthest(sky)  # 0 of a single one
        x, y, z = center.tolist()
        return replace(self, sky=Ball((x, y, z), reach / far)) if 0 < reach < far else self

    def within(self, reach: float, size: float) -> "ModelSource":
        """This model, made smaller around the origin of its frame until it fits: seen from there it is equal.

        Args: reach, the largest coordinate, and size, the largest of a Gaussian, that a file can hold.
        Raises PlyError if the file has changed meanwhile.
        """
        shrink = 1.0
        for piece in self.pieces():
            far, large = float(np.abs(piece.means).max()), float(np.exp(piece.scales.max()))
            shrink = min(shrink, _INSIDE * reach / max(far, _INSIDE), size / large)
        return self if shrink == 1 else replace(self, scale=self.scale * shrink)

    def pieces(self) -> Iterator[Splats]:
        """The Gaussians, `ROWS` or fewer at a time. Raises PlyError if the file has changed meanwhile."""
        for chosen in self._selected():
            yield chosen.reduced(self.degree).turned(self.frame).scaled(self.scale)

    def _selected(self) -> Iterator[Splats]:
        """In the coordinates of the model."""
        for gaussians in read_ply_chunks(self.path, ROWS):
            piece, scene = Splats.of(gaussians), np.arange(len(gaussians)) < len(gaussians) - gaussians.sky
            if self.sky is not None and not scene.all():
                piece = Splats.joined([piece.select(scene), self.sky.of(piece.select(~scene))])
            chosen = piece.select(self.selection.keeps(piece, scene))
            if len(chosen):
                yield chosen


def quaternions(kept: NDArray[np.floating], largest: NDArray[np.integer]) -> NDArray[np.floating]:
    """(N, 4) of length 1, of their three smaller components (N, 3) in order and which one is the largest."""
    found = np.empty((len(kept), 4), kept.dtype)
    np.put_along_axis(found, KEPT[largest], kept, axis=1)
    rest = np.sqrt(np.maximum(0, 1 - np.square(kept).sum(axis=1, keepdims=True)))
    np.put_along_axis(found, largest[:, None].astype(np.int64), rest, axis=1)
    return np.asarray(found / np.linalg.norm(found, axis=1, keepdims=True))


def packed_but_largest(codes: NDArray[np.uint32], largest: NDArray[np.integer]) -> NDArray[np.uint32]:
    """(N,) words of which component is the largest, and the codes (N, 4) of the others, 10 bits of each."""
    packed = largest.astype(np.uint32)
    for code in np.take_along_axis(codes, KEPT[largest], axis=1).T:
        packed = packed << np.uint32(10) | code
    return packed
