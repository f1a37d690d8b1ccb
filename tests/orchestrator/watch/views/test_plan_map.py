"""The map of a run and its picture, its curve of exposures, and the colours of blocks."""

import base64
import json
from dataclasses import replace
from itertools import combinations, pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from panolog.orchestrator.runs.folder import RunFolder
from panolog.orchestrator.watch.views import plan_map
from panolog.orchestrator.watch.views.block_colors import BLOCK_COLORS, SEAM_GRADES, block_color
from panolog.orchestrator.watch.views.exposures import exposure_curve
from panolog.orchestrator.watch.views.pages.encoding import encode
from panolog.orchestrator.watch.views.plan_picture import BELOW, LABEL, SIDE, WIDTH, plan_picture
from panolog.partition.cells import Grid
from panolog.partition.contraction import contract
from panolog.partition.plan import PartitionConfig, Plan, make_plan
from panolog.scene.ply import write_ply
from tests.scene.test_ply import gaussians

GRID = Grid((3, 2, 2))


@pytest.fixture
def plan() -> Plan:
    """Cameras spread least along z, so it is seen from there; most stand in the upper layer."""
    random = np.random.default_rng(0)
    centers = random.uniform(-1, 1, (20, 3)) * [9, 6, 0.5] + [0, 0, 0.1]
    scores, names = random.random((20, GRID.count)), [f"<b>{k}</b>.jpg" for k in range(20)]
    means = random.normal(size=(300, 3)) * 9
    return make_plan(centers, means, scores, GRID, PartitionConfig(), rows=range(10, 30), names=names)


POINTS = np.random.default_rng(1).normal(size=(400, 3)) * 5


def trace(figure: plan_map.Figure, name: str) -> dict[str, Any]:
    return next(item for item in figure["data"] if item["name"] == name)


def test_the_figure_is_json(plan: Plan) -> None:
    """Arrays are in base64, for which `drawing.js` has these types."""
    figure = plan_map.map_figure(plan, POINTS)
    for name, dtype in (("blocks", "i2"), ("points", "u1")):
        raster, packed = trace(figure, name)["z"], trace(json.loads(encode(figure)), name)["z"]
        assert (packed["dtype"], packed["shape"]) == (dtype, ", ".join(map(str, raster.shape)))
        assert (np.frombuffer(base64.b64decode(packed["bdata"]), dtype) == raster.ravel()).all()


def test_fixes_of_gps_are_seen_from_above_and_stand_for_cameras_without_a_pose(plan: Plan) -> None:
    fixes = np.array([[1.0, 2.0, 30.0], [-3.5, 4.0, np.pi]])
    figure = plan_map.map_figure(plan, POINTS, fixes=fixes)
    assert (trace(figure, "fixes")["x"], trace(figure, "fixes")["y"]) == ([1.0, -3.5], [2.0, 4.0])
    assert len(trace(figure, "cameras")["x"]) == len(plan.rows)
    nameless = replace(plan, names=("",) * len(plan.rows))
    before = plan_map.map_figure(nameless, POINTS[:0], planned=False, fixes=plan.centers)
    assert trace(before, "cameras")["x"] == before["blocks"]["names"] == []
    assert len(trace(before, "fixes")["x"]) == len(plan.rows)
    assert trace(plan_map.map_figure(plan, POINTS), "fixes")["x"] == []


def test_each_pixel_has_the_block_of_its_place(plan: Plan) -> None:
    figure = plan_map.map_figure(plan, POINTS)
    cells, blocks = trace(figure, "blocks"), figure["blocks"]
    ids = cells["z"] + blocks["layer"] * blocks["stride"]
    assert (blocks["layers"], blocks["stride"], blocks["count"]) == (2, 6, 12)
    rows, columns = np.random.default_rng(2).integers(0, ids.shape, (200, 2)).T
    height = plan.aabb.center[2] + (0.1 if blocks["layer"] else -0.1) * plan.aabb.half[2]
    places = np.column_stack(
        [cells["x0"] + cells["dx"] * columns, cells["y0"] + cells["dy"] * rows, np.full(200, height)]
    )
    expected = [next(b for b in range(12) if plan.cell(b).contains(place[None])[0]) for place in places]
    assert (ids[rows, columns] == expected).mean() > 0.98  # but for pixels that a face crosses


def test_cameras_have_a_ring_for_each_further_block_and_all_that_it_trains(plan: Plan) -> None:
    figure = plan_map.map_figure(plan, POINTS)
    served = plan.assignment.assigned.sum(axis=1)
    for ring in (1, 2):
        assert len(trace(figure, f"cameras, ring {ring}")["x"]) == (served > ring).sum()
    assert trace(figure, "cameras")["text"][0].startswith("trains block")
    assert figure["blocks"]["names"][0] == "<b>0</b>.jpg"


def test_points_of_a_model_are_thinned_and_without_sky(tmp_path: Path) -> None:
    model = gaussians(50, sky=10)
    write_ply(tmp_path / "model.ply", model)
    means = model.means.numpy()
    np.testing.assert_array_equal(plan_map.read_points(tmp_path / "model.ply"), means[:40])
    np.testing.assert_array_equal(plan_map.read_points(tmp_path / "model.ply", most=10), means[:40:4])


def test_faces_have_the_colour_of_their_seam_the_worst_above(plan: Plan) -> None:
    """Blocks 0 and 1 meet along x; 0 and 6 lie on top of each other: no line is seen of their face."""
    seams = {(0, 1): 9.0, (1, 2): 1.0, (0, 6): 5.0, (0, 99): 5.0}
    figure = plan_map.map_figure(plan, POINTS, seams=seams)
    lines = [item for item in figure["data"] if item["name"] == "seams"]
    assert [line["line"]["color"] for line in lines] == [
        SEAM_GRADES["hardly"][1],
        SEAM_GRADES["clear"][1],
    ]
    assert "blocks 0 and 1: 9.00" in lines[-1]["text"]
    assert figure["blocks"]["grades"] == [
        ["seam below 1.5", SEAM_GRADES["hardly"][1]],
        ["seam 3 and more", SEAM_GRADES["clear"][1]],
    ]
    x, y = (np.array(lines[-1][axis]) for axis in "xy")
    inside = np.abs(y - plan.aabb.center[1]) < 0.9 * plan.aabb.half[1]
    places = np.column_stack([x, y, np.full(len(x), plan.aabb.center[2] - 0.1)])[inside]
    for side, block in ((-1e-3, 0), (1e-3, 1)):
        moved = contract(places + np.array([side, 0, 0]), plan.aabb)
        assert (plan.grid.block_of(moved) == block).all()


def written(root: Path, content: Any) -> RunFolder:
    (root / "exposure.json").write_text(content if isinstance(content, str) else json.dumps(content))
    return RunFolder(root)


def panorama(number: int, **changes: Any) -> dict[str, Any]:
    return {
        "name": f"{number}.jpg",
        "stops": number / 100,
        "gain": [1, 2, 0.5],
        "black": [0, 0, 0],
        **changes,
    }


def test_a_curve_has_both_ends_and_stops_of_each_channel(tmp_path: Path) -> None:
    folder = written(tmp_path, {"panoramas": [panorama(number) for number in range(1_500)]})
    curve = exposure_curve(folder)
    assert curve is not None
    assert len(curve.name) == len(curve.stops) == len(curve.red) == 600
    assert (curve.name[0], curve.name[-1], curve.stops[-1]) == ("0.jpg", "1499.jpg", 14.99)
    assert (curve.red[0], curve.green[0], curve.blue[0]) == (0, 1, -1)


@pytest.mark.parametrize(
    "content",
    [
        "",
        "{",
        {"panoramas": []},
        {"panoramas": [panorama(0, gain=[0, 1, 1])]},
        '{"panoramas": [{"name": "a", "stops": NaN, "gain": [1, 1, 1]}]}',
        "[" * 100_000,
    ],
)
def test_another_format_is_no_curve(content: Any, tmp_path: Path) -> None:
    assert exposure_curve(written(tmp_path, content)) is None


# Linear RGB as seen with no red and with no green cones: Machado, Oliveira and Fernandes 2009, severity 1.
EYES = {
    "all cones": np.eye(3),
    "no red": np.array(
        [
            [0.152286, 1.052583, -0.204868],
            [0.114503, 0.786281, 0.099216],
            [-0.003882, -0.048116, 1.051998],
        ]
    ),
    "no green": np.array(
        [[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413], [-0.011820, 0.042940, 0.968881]]
    ),
}
XYZ = np.array([[0.41246, 0.35758, 0.18044], [0.21267, 0.71515, 0.07217], [0.01933, 0.11919, 0.95030]])


def linear(color: str) -> NDArray[np.float64]:
    parts = np.array([int(color[i : i + 2], 16) for i in (1, 3, 5)]) / 255
    return np.where(parts <= 0.04045, parts / 12.92, ((parts + 0.055) / 1.055) ** 2.4)


def lab(rgb: NDArray[np.float64]) -> NDArray[np.float64]:
    """CIELAB, D65."""
    x, y, z = np.cbrt(np.maximum(np.clip(rgb, 0, 1) @ XYZ.T / [0.95047, 1, 1.08883], 1e-6))
    return np.array([116 * y - 16, 500 * (x - y), 200 * (y - z)])


def luminance(color: str) -> float:
    return float(linear(color) @ [0.2126, 0.7152, 0.0722])


@pytest.mark.parametrize("across", range(1, 7))
def test_neighbours_in_a_grid_have_different_colours(across: int) -> None:
    colors = [block_color(block) for block in range(100)]
    assert all(a != b for a, b in pairwise(colors))
    assert all(a != b for a, b in zip(colors, colors[across:], strict=False))


def test_block_colours_stand_out_from_light_and_dark() -> None:
    for color in BLOCK_COLORS:
        assert 1.05 / (luminance(color) + 0.05) > 3
        assert (luminance(color) + 0.05) / (luminance("#151a21") + 0.05) > 3


@pytest.mark.parametrize("eyes", EYES)
def test_blocks_can_be_told_apart(eyes: str) -> None:
    seen = [lab(EYES[eyes] @ linear(color)) for color in BLOCK_COLORS]
    assert min(np.linalg.norm(a - b) for a, b in combinations(seen, 2)) > 19


# Blocks, and half the extent of the cameras.
SHAPES = {
    "a long street": ((4, 1, 1), (80, 4, 0.2)),
    "a square": ((2, 2, 1), (20, 20, 0.2)),
    "one block": ((1, 1, 1), (20, 14, 0.2)),
    "many blocks": ((4, 1, 4), (40, 0.3, 40)),
    "a tall scene": ((1, 4, 1), (4, 60, 0.2)),
    "layers": ((3, 2, 3), (30, 20, 2)),
}


def plan_of(blocks: tuple[int, int, int], extent: tuple[float, float, float], points: int) -> Plan:
    random, grid = np.random.default_rng(0), Grid(blocks)
    centers = random.uniform(-1, 1, (40, 3)) * extent
    cloud = random.uniform(-1.2, 1.2, (points, 3)) * extent
    scores, names = random.random((40, grid.count)) ** 6, [f"{i}.jpg" for i in range(40)]
    return make_plan(centers, cloud, scores, grid, PartitionConfig(), rows=range(40), names=names)


@pytest.mark.parametrize("shape", SHAPES)
def test_the_picture_is_full_and_nothing_lies_over_anything_else(shape: str) -> None:
    blocks, extent = SHAPES[shape]
    plan = plan_of(blocks, extent, 500)
    cloud = np.random.default_rng(1).uniform(-1.2, 1.2, (0 if shape == "a square" else 500, 3)) * extent
    picture = np.asarray(plan_picture(plan, cloud)).astype(int)
    used = picture.min(axis=2) < 250
    assert (used.mean(axis=1) > 0.5).mean() > 0.65  # rows with the map across them
    assert (used.mean(axis=0) > 0.5).mean() > 0.85  # columns
    rim = np.concatenate([used[:4].ravel(), used[-4:].ravel(), used[:, :4].ravel(), used[:, -4:].ravel()])
    assert not rim.any()  # no text is cut off
    figure = plan_map.map_figure(plan, cloud)
    (left, right), (bottom, _) = (figure["layout"][axis]["range"] for axis in ("xaxis", "yaxis"))
    scale = (WIDTH - 2 * SIDE) / (right - left)

    def pixels(name: str) -> NDArray[np.float64]:
        """(P, 2) rows and columns."""
        part = trace(figure, name)
        x, y = np.array(part["x"]), np.array(part["y"])
        return np.column_stack([len(picture) - BELOW - (y - bottom) * scale, SIDE + (x - left) * scale])

    cameras, labels = pixels("cameras"), pixels("labels")
    colors = [
        [int(color[i : i + 2], 16) for i in (1, 3, 5)]
        for color in trace(figure, "cameras")["marker"]["color"]
    ]
    rows, columns = cameras.round().astype(int).T
    gaps = np.linalg.norm(cameras[:, None] - cameras, axis=2)
    np.fill_diagonal(gaps, np.inf)
    alone = gaps.min(axis=1) > 20  # pixels: no other covers it
    assert alone.sum() >= 10
    assert abs(picture[rows, columns] - colors)[alone].max() < 12
    assert len(labels) >= min(4, plan.grid.count)
    between = np.linalg.norm(labels[:, None] - np.concatenate([labels, cameras]), axis=2)
    np.fill_diagonal(between, np.inf)
    assert between[:, : len(labels)].min(initial=np.inf) > 2 * LABEL
    assert between[:, len(labels) :].min() > LABEL
    rims = picture[labels[:, 0].astype(int), (labels[:, 1] + LABEL - 1.5).astype(int)]
    wanted = [figure["blocks"]["colors"][block] for block in trace(figure, "labels")["customdata"]]
    assert abs(rims - [[int(color[i : i + 2], 16) for i in (1, 3, 5)] for color in wanted]).max() < 12
