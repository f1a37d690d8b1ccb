"""Reconstructions that contradict their matches: how they are known, and that the mapper begins again."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from panolog.prepare.sfm import contradictions as module
from panolog.prepare.sfm import mapping
from panolog.prepare.sfm.contradictions import Contradiction, find_contradictions
from panolog.prepare.sfm.workspace import Workspace
from panolog.scene.write import no_progress


@dataclass(frozen=True)
class Model:
    """As much of a reconstruction as choosing one needs."""

    first: tuple[int, int] | None  # the pair that it began with
    images: int = 8
    points: int = 1000

    def num_reg_images(self) -> int:
        return self.images

    def num_points3D(self) -> int:  # noqa: N802
        return self.points


def _work(folder: Path) -> Workspace:
    return Workspace(folder, ())


@pytest.mark.parametrize("points, found", [(450, False), (250, False), (150, True), (0, True)])
def test_pairs_that_share_most_must_see_the_same(
    points: int, found: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    neighbours = [Contradiction((row, row + 1), 600, 480) for row in range(5)]
    suspect = Contradiction((5, 6), 600, points)
    far = Contradiction((0, 6), 200, 0)  # repeats may match without harm where both have stronger neighbours
    monkeypatch.setattr(module, "_pairs", lambda *_: [*neighbours, suspect, far])
    model: Any = Model(None)
    assert find_contradictions(_work(tmp_path), model) == ([suspect] if found else [])


def test_nothing_to_compare(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "_pairs", lambda *_: [])
    model: Any = Model(None)
    assert find_contradictions(_work(tmp_path), model) == []


@pytest.mark.parametrize(
    "outcomes, chosen, tries",
    [
        ({None: 0}, None, 1),
        ({None: 2, (3, 4): 0}, (3, 4), 2),
        ({None: 2, (3, 4): 2}, None, 2),  # the same pair is not tried twice
        ({None: 1, (3, 4): 3}, None, 2),
    ],
)
def test_the_mapper_begins_again_with_what_was_contradicted(
    outcomes: dict[tuple[int, int] | None, int],
    chosen: tuple[int, int] | None,
    tries: int,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    begun: list[tuple[int, int] | None] = []

    def grow(work: object, max_error: float, progress: object, first: tuple[int, int] | None) -> list[Model]:
        begun.append(first)
        return [Model(first)]

    monkeypatch.setattr(mapping, "_incremental", grow)
    monkeypatch.setattr(
        mapping,
        "find_contradictions",
        lambda _, model: [Contradiction((3, 4), 300, 2)] * outcomes[model.first],
    )
    mapped = mapping.map_panoramas(_work(tmp_path), "incremental", 2.0, no_progress)
    assert mapped is not None
    model: Any = mapped[0]
    assert model.first == chosen
    assert len(begun) == tries


def test_more_panoramas_are_worth_more_than_fewer_contradictions(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    models = {None: Model(None, images=8), (3, 4): Model((3, 4), images=5)}
    monkeypatch.setattr(mapping, "_incremental", lambda *arguments: [models[arguments[3]]])
    monkeypatch.setattr(
        mapping,
        "find_contradictions",
        lambda _, model: [Contradiction((3, 4), 300, 2)] * (model.first is None),
    )
    mapped = mapping.map_panoramas(_work(tmp_path), "incremental", 2.0, no_progress)
    assert mapped is not None
    model: Any = mapped[0]
    assert model.first is None
