"""Cameras in a painted hollow sphere: what is drawn into one picture is found, and nothing else."""

from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from panolog.scene.images import View, exposed
from panolog.scene.model import Panorama, Scene
from panolog.workers.capture import movers as module
from panolog.workers.capture.config import MoversConfig
from panolog.workers.capture.movers import Movers, Visit, state_bytes
from tests.workers.small import RADIUS, distance_along, rays_of
from tests.workers.trainings import threads

WIDTH, HEIGHT = 256, 128
CENTERS = np.array([[0, 0, 0], [1.2, 0, 0.3], [-1.1, 0.2, 0], [0, 0, 1.3], [0.3, -0.2, -1.2], [1.0, 0, 1.1]])
ON = MoversConfig(weigh=True)
LATE = 96  # an iteration at which views are judged, with the factor as configured
TASK = 100
CELL = WIDTH // (WIDTH // 4)


def turned(index: int) -> np.ndarray:
    """A rotation, another for each camera."""
    rotation: np.ndarray = Rotation.from_euler("yx", [0.7 * index, 0.1]).as_matrix()
    return rotation


def surface(index: int) -> tuple[np.ndarray, np.ndarray]:
    """Points (H, W, 3) on the sphere that a camera sees, and their distances (H, W)."""
    directions = rays_of(WIDTH) @ turned(index)
    distance = distance_along(directions, CENTERS[index])
    return CENTERS[index] + distance[..., None] * directions, distance


def painted(index: int) -> Tensor:
    points, _ = surface(index)
    return torch.from_numpy((255 * (0.5 + 0.3 * np.sin(points))).astype(np.uint8))


def scene(count: int = len(CENTERS)) -> Scene:
    panoramas = tuple(
        Panorama(f"{i}.jpg", Path(f"{i}.jpg"), turned(i), -turned(i) @ CENTERS[i], np.zeros(0, np.int64))
        for i in range(count)
    )
    points, colors, rows = np.zeros((0, 3)), np.zeros((0, 3), np.uint8), tuple(range(count))
    return Scene(Path(), WIDTH, HEIGHT, panoramas, points, colors, rows, (), "")


def made(count: int = len(CENTERS), config: MoversConfig = ON) -> Movers:
    movers = Movers.of(scene(count), range(count), config, "cpu", WIDTH, TASK)
    assert movers is not None
    return movers


def visit(
    movers: Movers,
    photographs: dict[int, Tensor] | None = None,
    renders: dict[int, Tensor] | None = None,
    *,
    iteration: int = LATE,
    status: Tensor | None = None,
    affine: Tensor | None = None,
) -> None:
    """Each view once; the last visit is at `iteration`. Args: affine, exposure of all photographs."""
    count = len(movers.learnt())
    for index in range(count):
        image = (photographs or {}).get(index, painted(index))
        color = (renders or {}).get(index, painted(index)).float() / 255
        inverse = torch.from_numpy(1 / surface(index)[1]).float()
        movers.step(
            Visit(
                row=index,
                iteration=iteration - count + 1 + index,
                image=exposed(image, affine),
                color=color,
                affine=affine,
                inverse_depth=inverse,
                status=status,
            )
        )


def figure(index: int, columns: range, rows: range = range(50, 80)) -> Tensor:
    """A picture with something black in it."""
    image = painted(index)
    image[rows.start : rows.stop, [column % WIDTH for column in columns]] = 0
    return image


def cells(columns: range, rim: int = 0, rows: range = range(50, 80)) -> np.ndarray:
    """(h, w) bool: the cells of a figure, and so many pixels around it."""
    inside = np.zeros((HEIGHT // CELL, WIDTH // CELL), bool)
    wide = {column // CELL % (WIDTH // CELL) for column in range(columns.start - rim, columns.stop + rim)}
    inside[(rows.start - rim) // CELL : -(-(rows.stop + rim) // CELL), sorted(wide)] = True
    return inside


@pytest.mark.parametrize("affine", [None, torch.tensor([[0.6] * 3, [0.1] * 3])], ids=["as it is", "exposed"])
@pytest.mark.parametrize("columns", [range(100, 116), range(-8, 8)], ids=["middle", "seam"])
def test_a_figure_in_one_view_is_found_there_and_nowhere_else(columns: range, affine: Tensor | None) -> None:
    movers = made()
    visit(movers, {2: figure(2, columns)}, affine=affine)
    found = movers.learnt()
    assert found[2][cells(columns)].mean() > 0.9
    assert not found[2][~cells(columns, rim=3 * CELL)].any()
    assert not np.delete(found, 2, axis=0).any()


def test_what_no_view_has_learnt_yet_does_not_move() -> None:
    """A part of the place that all renders lack is elsewhere in each picture: found by its distance."""
    highest = []
    for sign in (1, -1):  # then with cameras in wrong places
        movers = made()
        movers._views.centers.mul_(sign)
        visit(movers, renders={index: lacking(index) for index in range(len(CENTERS))})
        numbers = torch.arange(len(CENTERS))
        slots = (LATE - len(CENTERS) + 1 + numbers) % 16
        highest.append(float(movers._compared(numbers, slots)[0].max()))
        assert not movers.learnt().any()
    assert highest[0] < 1.5
    assert highest[1] > 3


def lacking(index: int) -> Tensor:
    """A picture without a part of the place."""
    render = painted(index)
    render[np.linalg.norm(surface(index)[0] - np.array([0, 0.2, RADIUS]), axis=-1) < 1.2] = 0
    return render


def test_what_only_the_nearest_view_resolves_does_not_move() -> None:
    """Its error is the highest, but the photographs around show some of it, too."""
    photographs = {}
    for index in range(len(CENTERS)):
        image = painted(index)
        inside = np.linalg.norm(surface(index)[0] - np.array([0, 0.2, RADIUS]), axis=-1) < 1.2
        image[inside] = image[inside] // (8 if index == 2 else 2)
        photographs[index] = image
    renders = {index: painted(index) if index == 2 else photographs[index] for index in photographs}
    movers = made()
    visit(movers, photographs, renders)
    assert not movers.learnt().any()
    alone = made()
    visit(alone, {2: photographs[2]}, {2: painted(2)})
    assert alone.learnt()[2].any()


def test_a_verdict_heals() -> None:
    movers, columns = made(), range(100, 116)
    visit(movers, {2: figure(2, columns)})
    assert movers.learnt()[2].any()
    visit(movers)
    assert not movers.learnt().any()


def test_what_was_a_mover_stays_one_below_the_factor() -> None:
    """Or verdicts would change with each visit."""
    columns = range(100, 116)
    black, grey = figure(2, columns), painted(2)
    grey[50:80, 100:116] = grey[50:80, 100:116] // 2 + 12
    fresh, known = (made(config=MoversConfig(weigh=True, factor=10)) for _ in range(2))
    visit(fresh, {2: grey})
    assert not fresh.learnt().any()
    visit(known, {2: black})
    visit(known, {2: grey})
    assert known.learnt()[2][cells(columns)].mean() > 0.5


def test_nothing_is_judged_before_the_place_has_a_shape() -> None:
    movers = made()
    visit(movers, {2: figure(2, range(100, 116))}, iteration=len(CENTERS))
    assert not movers.learnt().any()


def test_at_first_only_the_strongest_is_left_out() -> None:
    found = []
    for iteration in (16, LATE):
        movers = made(config=MoversConfig(weigh=True, factor=17))
        visit(movers, {2: figure(2, range(100, 116))}, iteration=iteration)
        found.append(movers.learnt()[2].any())
    assert found == [False, True]


def test_a_view_that_is_off_as_a_whole_has_no_movers() -> None:
    movers = made()
    visit(movers, {2: 255 - painted(2)})
    assert not movers.learnt().any()


def test_masked_cells_are_not_judged() -> None:
    movers, columns = made(), range(100, 116)
    mask = torch.ones((HEIGHT, WIDTH), dtype=torch.bool)
    mask[48:84, 96:120] = False
    image = figure(2, columns)
    assert movers.still(View(2, image, mask, None, None)) is None
    visit(movers, {2: image})
    assert not movers.learnt().any()


@pytest.mark.parametrize("count", [3, len(CENTERS)])
def test_its_memory_is_what_estimates_count(count: int) -> None:
    movers = made(count)
    for index in range(count):
        mask = torch.ones((HEIGHT, WIDTH), dtype=torch.bool)
        movers.still(View(index, painted(index), mask, None, None))
    kept = [*movers._state.values(), *movers._used.values()]
    assert sum(tensor.nbytes for tensor in kept) == state_bytes(ON, count, WIDTH)
    assert state_bytes(MoversConfig(), count, WIDTH) == state_bytes(ON, 2, WIDTH) == 0


def test_what_moves_is_left_out_of_a_view() -> None:
    movers, columns = made(), range(100, 116)
    image = figure(2, columns)
    view = View(2, image, None, None, None)
    assert movers.still(view) is None
    visit(movers, {2: image})
    still = movers.still(view)
    assert still is not None and still.shape == (HEIGHT, WIDTH)
    assert float(still[52:78, 102:114].float().mean()) < 0.1 and still[:, 140:].all()
    wide = View(2, torch.zeros((2 * HEIGHT, 2 * WIDTH, 3), dtype=torch.uint8), None, None, None)
    wider = movers.still(wide)
    assert wider is not None and torch.equal(wider[::2, ::2], still)


def test_an_iteration_that_did_not_take_place_says_nothing() -> None:
    movers, before = made(), made()
    visit(movers, {2: figure(2, range(100, 116))}, status=torch.ones(1, dtype=torch.int32))
    for name in ("errors", "colors", "rendered", "inverse", "moving"):
        assert torch.equal(movers.tensors()[f"movers.{name}"], before.tensors()[f"movers.{name}"]), name
    visit(movers, {2: figure(2, range(100, 116))}, status=torch.zeros(1, dtype=torch.int32))
    assert movers.learnt()[2].any()


def test_no_number_of_threads_changes_a_verdict(monkeypatch: pytest.MonkeyPatch) -> None:
    results, generator = [], torch.Generator().manual_seed(0)
    noise = {i: (torch.rand((HEIGHT, WIDTH, 3), generator=generator) * 255).byte() for i in range(6)}
    monkeypatch.setattr(module, "_MOST", 1.0)
    for count in (1, 2, 5):
        with threads(count):
            movers = made(config=MoversConfig(weigh=True, factor=1))
            visit(movers, noise)
        results.append({name: tensor.numpy().tobytes() for name, tensor in movers.tensors().items()})
    assert results[0] == results[1] == results[2]


def test_two_views_say_nothing_and_the_setting_turns_it_off() -> None:
    assert Movers.of(scene(), range(6), MoversConfig(), "cpu", WIDTH, TASK) is None
    assert Movers.of(scene(), range(2), ON, "cpu", WIDTH, TASK) is None


def test_views_at_one_place_are_neighbours_of_each_other_and_not_of_themselves() -> None:
    one = scene()
    views = module.Views.of(Scene(**{**vars(one), "panoramas": (one.panoramas[0],) * 7}), range(7), "cpu")
    assert views.unit == 1.0 and views.nearest.shape == (7, 4)
    assert not (views.nearest == torch.arange(7)[:, None]).any()
