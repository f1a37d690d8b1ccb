"""The map of a run as a plotly figure: plain dicts, ready for JSON. The page paints the cells."""

import base64
from collections.abc import Iterable, Mapping, Sequence
from html import escape
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from panolog.orchestrator.watch.views.palette import SEAM_GRADES, block_color, seam_grade
from panolog.orchestrator.watch.views.plan_map import LABELS, RINGS, MapWindow, served, window_on
from panolog.partition.faces import planes_between
from panolog.partition.plan import Plan

Figure = dict[str, Any]  # {"data": traces, "layout": layout}

_INK, _GREY, _GRID = "#22272e", "#7b8696", "rgba(125,135,150,0.25)"
_FONT = "system-ui, -apple-system, 'Segoe UI', Roboto, 'Noto Sans', sans-serif"
_RINGED = 1_500  # cameras up to which rings are drawn: each is a shape of its own


def map_figure(
    plan: Plan,
    points: NDArray[np.floating],
    seams: Mapping[tuple[int, int], float] | None = None,
    *,
    planned: bool = True,
    fixes: NDArray[np.floating] = np.empty((0, 3)),  # noqa: B008  # never changed
) -> Figure:
    """A plan from above in world space: cells, faces, AABB, points, fixes of GPS and cameras.

    The figure has one more key, "blocks": `planned`; `count` and `colors` of all blocks; `names` of cameras,
    `grades` for the legend of seams, and for blocks on top of each other `layers`, the `layer` shown and the
    `stride` of ids between layers. The trace "blocks" has the ids of the lowest layer as `z`.

    Args: points (P, 3) of the scene, such as those of `plan_map.read_points`; seams of faces by their blocks;
    planned, False of an outline: its only block is none, and cameras without a name are fixes; fixes (F, 3).
    """
    view = window_on(plan, points)
    return {
        "data": [
            _cells(view),
            _density(view, points),
            _line("faces", view.faces(), _GREY, "solid"),
            *_seams(view, seams or {}),
            _line("box", view.outline()[: None if planned else 0], _GREY, "dash"),
            _fixes(view, fixes),
            *_cameras(view, planned=planned),
            _labels(view, planned=planned),
        ],
        "layout": _map_layout(view),
        "blocks": {
            "planned": planned,
            "count": plan.grid.count,
            "colors": view.colors,
            "names": list(filter(None, plan.names)),
            "grades": _grades((seams or {}).values()),
            "layers": view.layers,
            "layer": view.layer,
            "stride": view.stride,
        },
    }


def _packed(values: NDArray[Any]) -> dict[str, str]:
    """An array as plotly accepts it in JSON, in base64: a fraction of the size of its digits."""
    data = base64.b64encode(np.ascontiguousarray(values).tobytes()).decode()
    shape = ", ".join(map(str, values.shape))
    return {"dtype": values.dtype.str.lstrip("<|"), "bdata": data, "shape": shape}


def _steps(view: MapWindow, shape: tuple[int, ...]) -> dict[str, float]:
    """Where the pixels of a raster of the window are: the first centre, and the step to the next."""
    step = (view.upper - view.lower) / [shape[1], shape[0]]
    x0, y0 = view.lower + step / 2
    return {"x0": float(x0), "dx": float(step[0]), "y0": float(y0), "dy": float(step[1])}


def _cells(view: MapWindow) -> dict[str, Any]:
    """The blocks of the lowest layer as a transparent raster, for the pointer and for who paints them."""
    clear = "rgba(0,0,0,0)"
    return {
        "type": "heatmap",
        "name": "blocks",
        "z": _packed(view.cells.astype("<i2" if view.plan.grid.count < 2**15 else "<i4")),
        **_steps(view, view.cells.shape),
        "colorscale": [[0, clear], [1, clear]],
        "showscale": False,
        "hoverinfo": "none",
    }


def _grades(seams: Iterable[float]) -> list[list[str]]:
    """Text and colour of each grade of seams that there is."""
    present, limits = {seam_grade(seam) for seam in seams}, [least for least, _ in SEAM_GRADES.values()]
    spans = [f"{low:g} to {high:g}" if low else f"below {high:g}" for low, high in pairwise(limits)]
    return [
        [f"seam {span}", color]
        for (name, (_, color)), span in zip(
            SEAM_GRADES.items(), [*spans, f"{limits[-1]:g} and more"], strict=True
        )
        if name in present
    ]


def _density(view: MapWindow, points: NDArray[np.floating]) -> dict[str, Any]:
    density = view.density(points)
    return {
        "type": "heatmap",
        "name": "points",
        "z": _packed(density),
        **_steps(view, density.shape),
        "zmin": 0,
        "zmax": 255,
        "colorscale": [[0, "rgba(105,115,130,0)"], [0.02, "rgba(105,115,130,0.35)"], [1, "rgb(105,115,130)"]],
        "showscale": False,
        "hoverinfo": "skip",
    }


def _line(name: str, points: NDArray[np.float64], color: str, dash: str) -> dict[str, Any]:
    """A line through the points (L, 2), with a gap at each NaN."""
    x, y = ([None if np.isnan(v) else float(f"{v:.6g}") for v in column] for column in points.T)
    return {
        "type": "scatter",
        "mode": "lines",
        "name": name,
        "x": x,
        "y": y,
        "connectgaps": False,
        "line": {"color": color, "width": 1.2, "dash": dash},
        "hoverinfo": "skip",
    }


def _seams(view: MapWindow, seams: Mapping[tuple[int, int], float]) -> list[dict[str, Any]]:
    """A thick line for each face whose seam was measured, the worst above all others."""
    planes = {(plane.below, plane.above): plane for plane in planes_between(view.plan.grid)} if seams else {}
    traces = []
    for blocks, seam in sorted(seams.items(), key=lambda item: item[1]):
        if (plane := planes.get(blocks)) is not None and plane.axis != view.axes[2]:
            line = _line("seams", view.line(plane), SEAM_GRADES[seam_grade(seam)][1], "solid")
            line["line"]["width"] = 4.5
            text = f"seam between blocks {blocks[0]} and {blocks[1]}: {seam:.2f}"
            shown = {"text": text, "hoverinfo": "all", "hovertemplate": "%{text}<extra></extra>"}
            traces.append(line | shown)
    return traces


def _fixes(view: MapWindow, fixes: NDArray[np.floating]) -> dict[str, Any]:
    """A cross where GPS has each panorama."""
    across, up, _ = view.axes
    return {
        "type": "scatter",
        "mode": "markers",
        "name": "fixes",
        "x": np.round(fixes[:, across].astype(float), 3).tolist(),
        "y": np.round(fixes[:, up].astype(float), 3).tolist(),
        "marker": {
            "symbol": "cross-thin-open",
            "size": 9,
            "color": _GREY,
            "line": {"color": _GREY, "width": 1.5},
        },
        "hoverinfo": "skip",
    }


def _cameras(view: MapWindow, *, planned: bool) -> list[dict[str, Any]]:
    """A disc for each camera in the colour of its own block, and rings for other blocks that it trains."""
    plan = view.plan
    blocks = [served(plan, k) for k in range(len(plan.rows))]
    size = float(np.clip(60 / max(len(blocks), 1) ** 0.5, 0.45, 1.0))
    traces = []
    for ring in reversed(range(len(RINGS) if len(blocks) <= _RINGED else 1)):
        here = [k for k, its in enumerate(blocks) if len(its) > ring and plan.names[k]]
        places = plan.centers[here][:, list(view.axes[:2])]
        traces.append(
            {
                "type": "scatter",
                "mode": "markers",
                "name": "cameras" if ring == 0 else f"cameras, ring {ring}",
                "x": places[:, 0].tolist(),
                "y": places[:, 1].tolist(),
                "customdata": [plan.rows[k] for k in here],
                "text": [escape(plan.names[k]) + planned * f"<br>trains {_listed(blocks[k])}" for k in here],
                "marker": {
                    "size": RINGS[ring] * size,
                    "color": [block_color(blocks[k][ring]) for k in here],
                    "opacity": 1,
                    "line": {"color": "#ffffff", "width": 1.2 * size},
                },
                "hovertemplate": "%{text}<extra></extra>",
            }
        )
    return traces


def _listed(blocks: Sequence[int]) -> str:
    head = ", ".join(map(str, sorted(blocks)[:8]))
    return f"block{'s' * (len(blocks) > 1)} {head}{', …' * (len(blocks) > 8)}"


def _labels(view: MapWindow, *, planned: bool) -> dict[str, Any]:
    """The number of each cell on a disc, if there are not too many."""
    few = planned and len(np.unique(view.cells)) <= LABELS
    ids, places = view.labels() if few else (np.empty(0, np.int64), np.empty((0, 2)))
    shown = ids + view.layer * view.stride
    return {
        "type": "scatter",
        "mode": "markers+text",
        "name": "labels",
        "x": places[:, 0].tolist(),
        "y": places[:, 1].tolist(),
        "text": [str(b) for b in shown],
        "customdata": shown.tolist(),
        "textfont": {"size": 12, "color": _INK},
        "marker": {
            "size": 26,
            "color": "#ffffff",
            "opacity": 1,
            "line": {"color": [block_color(b) for b in shown.tolist()], "width": 2},
        },
        "hovertemplate": "block %{customdata}<extra></extra>",
    }


def _map_layout(view: MapWindow) -> dict[str, Any]:
    """Axes of equal scale, which end with the window."""
    across, up, _ = view.axes
    axes = []
    for i, axis in enumerate((across, up)):
        low, high = float(view.lower[i]), float(view.upper[i])
        line = {"gridcolor": _GRID, "linecolor": _GRID, "zeroline": False, "ticks": "", "automargin": True}
        title = {"text": f"{'xyz'[axis]} (world units)", "standoff": 8}
        axes.append(line | {"title": title, "showgrid": False, "range": [low, high], "constrain": "domain"})
    return {
        "paper_bgcolor": "rgba(0,0,0,0)",
        "plot_bgcolor": "rgba(0,0,0,0)",
        "font": {"family": _FONT, "size": 12, "color": "#5a6472"},
        "autosize": True,
        "margin": {"l": 14, "r": 20, "t": 4, "b": 4},
        "xaxis": axes[0],
        "yaxis": axes[1] | {"scaleanchor": "x", "scaleratio": 1},
        "showlegend": False,
        "hovermode": "closest",
        "dragmode": "pan",
        "uirevision": "map",
    }
