"""A known trajectory of the camera, from a phone or SLAM: which pairs are near, what scale the world has.

Formats: TUM, lines of `t x y z qx qy qz qw` (https://cvg.cit.tum.de/data/datasets/rgbd-dataset/file_formats),
and CSV with a header that has x, y and z, and name or a time. Attitudes are not used: how the other device
was turned against the camera is unknown.
"""

import csv
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from panolog.prepare.world.similarity import Similarity
from panolog.prepare.world.tracks import number_of
from panolog.scene.errors import SceneError

Array = NDArray[np.float64]
_LARGEST = 64 << 20  # bytes of a file
_TIMES = ("t", "time", "timestamp")
_NAMES = ("name", "image", "file", "filename")
_FEWEST = 3  # panoramas with a place
_LONGER = 500.0  # times as long as a video, in seconds: a trajectory in milliseconds
_ALIKE = 0.01  # metres: places of one panorama differ by no more
_FLAT = 0.02  # of the length of a walk: if it is straighter, its turn about itself is unknown


@dataclass(frozen=True, eq=False)
class Trajectory:
    """Where a device was."""

    path: Path
    places: Array  # (N, 3) metres
    times: Array | None  # (N,) seconds, ascending
    names: tuple[str, ...] | None  # of panoramas, with or without their suffix


def read_trajectory(path: Path) -> Trajectory:
    """Reads a file in one of the two formats. Raises SceneError with the line that is wrong; OSError."""
    if not path.is_file():
        raise SceneError(f"{path}: there is no such file; give a trajectory as TUM or CSV")
    if path.stat().st_size > _LARGEST:
        raise SceneError(f"{path}: is larger than {_LARGEST >> 20} MiB; give a trajectory as TUM or CSV")
    try:
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except UnicodeDecodeError as error:
        raise SceneError(f"{path}: is not text; give a trajectory as TUM or CSV") from error
    rows = [(number, line) for number, line in enumerate(lines, start=1) if line.strip()]
    rows = [(number, line) for number, line in rows if not line.lstrip().startswith("#")]
    if not rows:
        raise SceneError(f"{path}: is empty; give lines of t x y z qx qy qz qw, or CSV with a header")
    if "," in rows[0][1]:
        return _read_csv(path, rows)
    return _timed(path, np.array([_numbers(path, number, line.split(), 8)[:4] for number, line in rows]))


def check_times(trajectory: Trajectory, videos: Sequence[bool]) -> None:
    """Refuses times that may be those of one of several sources.

    Args: videos, for each source whether it is a video.
    Raises: SceneError.
    """
    if trajectory.names is None and len(videos) > 1 and any(videos):
        raise SceneError(
            f"{trajectory.path}: has times and no names, and a video by itself can be placed by them; give "
            "it alone, or name the panoramas in a column `name`"
        )


def places_of(trajectory: Trajectory, names: Sequence[str], times: Sequence[float] | None) -> Array:
    """(K, 3) where panoramas were taken, NaN for those that the trajectory does not know.

    Args: names, of the panoramas; times, seconds of a video's frames since its beginning. Photographs are
        matched by name, or by a time that is their name.
    Raises: SceneError, fewer than three match, or times are not in seconds.
    """
    stems = [Path(name).stem for name in names]
    found = np.full((len(names), 3), np.nan)
    if trajectory.names is not None:
        whole = {name: row for row, name in enumerate(trajectory.names)}
        of_name = {Path(name).name: row for row, name in enumerate(trajectory.names)}
        of_stem = {Path(name).stem: row for row, name in enumerate(trajectory.names)}
        files = [Path(name).name for name in names]
        often = Counter([*files, *stems])  # those of folders may have equal names
        for row, (name, file, stem) in enumerate(zip(names, files, stems, strict=True)):
            place = whole.get(name, of_name.get(file) if often[file] == 1 else None)
            if place is None and often[stem] == 1:
                place = of_stem.get(stem)
            if place is not None:
                found[row] = trajectory.places[place]
    elif trajectory.times is not None:
        lasts = float(np.ptp(trajectory.times))
        if times is not None and lasts > _LONGER * np.ptp(times):
            raise SceneError(
                f"{trajectory.path}: lasts {lasts:,.0f} seconds, and the frames of the video "
                f"{np.ptp(times):,.1f}; give its times in seconds, not in parts of them"
            )
        start = trajectory.times[0] if times is not None else 0.0
        wanted = np.array(list(times) if times is not None else [number_of(stem) for stem in stems]) + start
        inside = (wanted >= trajectory.times[0] - 0.5) & (wanted <= trajectory.times[-1] + 0.5)
        for axis in range(3):
            found[inside, axis] = np.interp(wanted[inside], trajectory.times, trajectory.places[:, axis])
    known = int(np.isfinite(found[:, 0]).sum())
    if known < _FEWEST:
        raise SceneError(
            f"{trajectory.path}: {known} of {len(names)} panoramas match it, at least {_FEWEST} are needed; "
            "name them in a column `name`, or call the files by their time in seconds, as in 1623.45.jpg"
        )
    return found


def near_pairs(places: Array, most: int) -> list[tuple[int, int]]:
    """Pairs of rows, ascending: each panorama with a place in (K, 3) and the `most` nearest others."""
    rows = np.flatnonzero(np.isfinite(places[:, 0]))
    pairs = set()
    for row in rows.tolist():
        away = np.linalg.norm(places[rows] - places[row], axis=1)
        for other in rows[np.argsort(away, kind="stable")[: most + 1]].tolist():
            if other != row:
                pairs.add((min(row, other), max(row, other)))
    return sorted(pairs)


def fit_world(centers: Array, places: Array) -> tuple[Similarity, float] | None:
    """The similarity from positions (K, 3) to places (K, 3), NaN for unknown, and what is left, in metres.

    Least squares (Umeyama, 1991), twice, the second time without those that are more than three times the
    median off. What is left is the median distance. None without three places that spread in two directions.
    """
    known = np.isfinite(places[:, 0])
    fitted: Similarity | None = None
    left = 0.0
    for _ in range(2):
        if known.sum() < _FEWEST:
            return None
        a, b = centers[known], places[known]
        spread = np.linalg.svd(b - b.mean(axis=0), compute_uv=False)
        if spread[0] == 0 or spread[1] < _FLAT * spread[0] or np.ptp(a, axis=0).max() == 0:
            return None
        fitted = _similarity(a, b)
        off = np.linalg.norm(fitted.points(centers) - places, axis=1)
        left = float(np.median(off[known]))
        known &= ~(off > 3 * left + 1e-9)
    return None if fitted is None else (fitted, left)


def _similarity(a: Array, b: Array) -> Similarity:
    middle, target = a.mean(axis=0), b.mean(axis=0)
    left, sizes, right = np.linalg.svd((b - target).T @ (a - middle))
    signs = np.array([1.0, 1.0, np.sign(np.linalg.det(left @ right))])
    rotation = (left * signs) @ right
    scale = float((sizes * signs).sum() / ((a - middle) ** 2).sum())
    return Similarity(scale, rotation, target - scale * rotation @ middle)


def _read_csv(path: Path, rows: Sequence[tuple[int, str]]) -> Trajectory:
    head = [cell.strip().lower() for cell in next(csv.reader([rows[0][1]]))]
    try:
        axes = [head.index(axis) for axis in ("x", "y", "z")]
    except ValueError as error:
        raise SceneError(
            f"{path}: line {rows[0][0]}: the header has no x, y and z; give name,x,y,z or t,x,y,z"
        ) from error
    key = next((head.index(name) for name in (*_NAMES, *_TIMES) if name in head), None)
    if key is None:
        raise SceneError(f"{path}: line {rows[0][0]}: the header has neither name nor t; give one of them")
    cells = [(number, next(csv.reader([line]))) for number, line in rows[1:]]
    for number, row in cells:
        if len(row) != len(head):
            raise SceneError(f"{path}: line {number}: has {len(row)} cells; the header has {len(head)}")
    named = head[key] in _NAMES
    columns = axes if named else [key, *axes]
    table = [_numbers(path, number, [row[it] for it in columns], len(columns)) for number, row in cells]
    values = np.array(table).reshape(-1, len(columns))
    if named:
        names = tuple(row[key].strip() for _, row in cells)
        _require_one_place(path, names, values, [number for number, _ in cells])
        return Trajectory(path, values, None, names)
    return _timed(path, values)


def _require_one_place(path: Path, names: Sequence[str], places: Array, numbers: Sequence[int]) -> None:
    """Raises SceneError if two lines have one name and different places. Args: numbers, of the lines."""
    first = dict[str, int]()
    for row, name in enumerate(names):
        before = first.setdefault(name, row)
        if not np.allclose(places[before], places[row], rtol=0, atol=_ALIKE):
            lines = f"lines {numbers[before]} and {numbers[row]}"
            raise SceneError(f"{path}: {lines}: two places for {name}; remove one of them")


def _timed(path: Path, table: Array) -> Trajectory:
    if not len(table):
        raise SceneError(f"{path}: has a header only; give a line for each place")
    order = np.argsort(table[:, 0], kind="stable")
    return Trajectory(path, table[order, 1:4], table[order, 0], None)


def _numbers(path: Path, number: int, cells: Sequence[str], count: int) -> list[float]:
    values = [number_of(cell) for cell in cells]
    if len(values) != count or not np.isfinite(values).all():
        raise SceneError(f"{path}: line {number}: is not {count} numbers; give t x y z qx qy qz qw, or CSV")
    return values
