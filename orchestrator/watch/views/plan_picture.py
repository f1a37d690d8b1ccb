"""plan.png: the map of a partition as a picture, for who has no page. It draws what `map_figure` says."""

import math
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageColor, ImageDraw, ImageFont

from panolog.orchestrator.runs.units import counted
from panolog.orchestrator.watch.views.plan_map import Figure, map_figure
from panolog.partition.plan import Plan
from panolog.scene.files import atomic

WIDTH, SIDE, BELOW = 1500, 80, 120  # pixels of the picture, left and right of the map, and below it
_FINE = 2  # by so many pixels each of these is drawn
_MARK = 5 / 3  # pixels for one of a figure
LABEL = 19  # pixels from the middle of a number to the rim of its disc
_COUNTED = 4  # blocks up to which the numbers of each are above the map
_TICKS = 12  # numbers of an axis, about
_INK, _GREY, _WHITE = "#22272e", "#59616d", "#ffffff"
_Draw = ImageDraw.ImageDraw


def write_plan_picture(path: Path, plan: Plan, points: NDArray[np.floating]) -> None:
    """Writes a picture of a plan, atomically: see `plan_picture`. Raises OSError if it cannot be written."""
    picture = plan_picture(plan, points)
    with atomic(path) as temporary:
        picture.save(temporary, "png")


def plan_picture(plan: Plan, points: NDArray[np.floating]) -> Image.Image:
    """A plan from above: cells in the colours of their blocks, AABB, points, cameras with rings, numbers.

    Args: points (P, 3) of the scene, such as means, in world units.
    """
    figure = map_figure(plan, points)
    axes = figure["layout"]["xaxis"], figure["layout"]["yaxis"]
    (left, right), (bottom, top) = (axis["range"] for axis in axes)
    scale = (WIDTH - 2 * SIDE) / (right - left)
    title, *lines = _lines(plan, figure["blocks"])
    above, height = 75 + 28 * len(lines), round((top - bottom) * scale)
    picture = Image.new("RGB", (_FINE * WIDTH, _FINE * (above + height + BELOW)), _WHITE)
    inside = _map(figure, (_FINE * (WIDTH - 2 * SIDE), _FINE * height))
    picture.paste(inside, (_FINE * SIDE, _FINE * above))
    draw = ImageDraw.Draw(picture)
    _text(draw, (SIDE, 35), title, "lm", 32, _INK)
    for row, line in enumerate(lines):
        _text(draw, (SIDE, 78 + 28 * row), line, "lm")
    for value in _ticks(left, right):
        _text(draw, (SIDE + (value - left) * scale, above + height + 16), f"{value:g}", "mm", 17)
    for value in _ticks(bottom, top):
        _text(draw, (SIDE - 10, above + (top - value) * scale), f"{value:g}", "rm", 17)
    names = " across, ".join(axis["title"]["text"] for axis in axes) + " up"
    _text(draw, (WIDTH / 2, above + height + 46), names, "mm")
    _legend(draw, figure["blocks"]["legend"], above + height + 88)
    return picture.reduce(_FINE)


def _map(figure: Figure, size: tuple[int, int]) -> Image.Image:
    """The parts of a figure as a picture of a size, those above others last."""
    parts, blocks = {part["name"]: part for part in figure["data"]}, figure["blocks"]
    (left, right), (_, top) = (figure["layout"][axis]["range"] for axis in ("xaxis", "yaxis"))
    colors = np.array([ImageColor.getrgb(color) for color in blocks["colors"]])
    shown = parts["blocks"]["z"] + blocks["layer"] * blocks["stride"]
    tints = (255 - 0.2 * (255 - colors)).astype(np.uint8)[shown]
    shades = (0.7 * parts["points"]["z"]).astype(np.uint8)
    cells, points = (Image.fromarray(raster[::-1]).resize(size, 0) for raster in (tints, shades))
    cells.paste(_INK, mask=points)
    draw, scale, unit = ImageDraw.Draw(cells), size[0] / (right - left), _FINE * _MARK

    def places(part: Figure) -> NDArray[np.float64]:
        """(P, 2) pixels; a gap is NaN."""
        x, y = np.array(part["x"], float), np.array(part["y"], float)
        return np.column_stack([(x - left) * scale, (top - y) * scale])

    faces = places(parts["faces"])
    for line in np.split(faces, np.flatnonzero(np.isnan(faces[:, 0]))):
        draw.line(line[np.isfinite(line)].tolist(), _INK, 2 * _FINE, joint="curve")
    for ends in pairwise(places(parts["box"])):
        _dashes(draw, *ends)
    for part in figure["data"]:
        if part["name"].startswith("cameras"):
            radius, edge = part["marker"]["size"] / 2 * unit, round(part["marker"]["line"]["width"] * unit)
            for place, color in zip(places(part).tolist(), part["marker"]["color"], strict=True):
                draw.circle(place, radius, color, _WHITE, edge)
    for (x, y), block in zip(places(parts["labels"]).tolist(), parts["labels"]["customdata"], strict=True):
        draw.circle((x, y), LABEL * _FINE, _WHITE, blocks["colors"][block], 3 * _FINE)
        _text(draw, (x / _FINE, y / _FINE), str(block), "mm", ink=_INK)
    return cells


def _dashes(draw: _Draw, begin: NDArray[np.float64], end: NDArray[np.float64]) -> None:
    """A dashed line between two pixels."""
    count = max(round(float(np.linalg.norm(end - begin)) / (20 * _FINE)), 1)
    for dash in np.arange(count):
        ends = [begin + (end - begin) * (dash + part) / count for part in (0.2, 0.8)]
        draw.line(np.ravel(ends).tolist(), _INK, 2 * _FINE)


def _lines(plan: Plan, blocks: Figure) -> list[str]:
    """Title and parameters, and the numbers of each block where there are few."""
    margin, gap, config = plan.baseline * plan.config.rho_tri, "   ·   ", plan.config
    title = f"{counted(plan.grid.count, 'block')} ({plan.grid}), {counted(len(plan.rows), 'camera')}"
    text = [f"{plan.assignment.overlap:.2f} blocks per camera", f"baseline {plan.baseline:.3g}"]
    text += [f"margin {margin:.3g}", f"rho_tri {config.rho_tri:g}, tau_grad {config.tau_grad:g}"]
    if blocks["layers"] > 1:
        text.append(f"layer {blocks['layer'] + 1} of {blocks['layers']}")
    numbers = [
        f"{block}: {counted(len(plan.cameras(block)), 'camera')}, {counted(int(own), 'Gaussian')}"
        for block, own in enumerate(plan.gaussians)
    ]
    return [title, gap.join(text), *([gap.join(numbers)] if len(numbers) <= _COUNTED else [])]


def _ticks(low: float, high: float) -> list[float]:
    """The round numbers between two, about `_TICKS`."""
    least = (high - low) / _TICKS
    power = 10.0 ** math.floor(math.log10(least))
    step = next(n * power for n in (1, 2, 5, 10) if n * power >= least)
    return [n * step for n in range(math.ceil(low / step), math.floor(high / step) + 1)]


def _legend(draw: _Draw, parts: list[tuple[str, str]], y: float) -> None:
    """Sign and meaning of each part, side by side in the middle."""
    font = ImageFont.load_default(19 * _FINE)
    x = (WIDTH - sum(font.getlength(text) / _FINE + 80 for _, text in parts) + 40) / 2
    for part, text in parts:
        place = np.array([x, y]) * _FINE
        if part == "box":
            _dashes(draw, *(place + np.array([[-18 * _FINE, 0], [18 * _FINE, 0]])))
        elif part == "points":
            for dot in ((-6, 5), (6, 5), (0, -5)):
                draw.circle((place + np.multiply(dot, _FINE)).tolist(), 2 * _FINE, _GREY)
        else:
            if part == "rings":
                draw.circle(place.tolist(), 12 * _FINE, _WHITE, _GREY, 2 * _FINE)
            draw.circle(place.tolist(), 7 * _FINE, _GREY)
        _text(draw, (x + 28, y), text, "lm")
        x += font.getlength(text) / _FINE + 80


def _text(
    draw: _Draw, at: tuple[float, float], text: str, anchor: str, size: int = 19, ink: str = _GREY
) -> None:
    """A text at a place of the picture. Args: size of its letters, pixels; anchor of Pillow."""
    place = (at[0] * _FINE, at[1] * _FINE)
    draw.text(place, text, ink, ImageFont.load_default(size * _FINE), anchor)
