"""Which Gaussians of a large model remain."""

import numpy as np

from panolog.export.reduce import Reduced, extent
from panolog.export.splats import ROWS, InMemory, Splats
from tests.export.gaussians import scattered


def some(count: int) -> Splats:
    """Random Gaussians; every third one is hardly visible."""
    model = scattered(count, 0, extent=3)
    model.opacities[:] = np.where(np.arange(count) % 3 == 0, -9, 3)
    return model


def all_of(source: Reduced) -> Splats:
    return Splats.joined(list(source.pieces()))


def test_of_a_large_model_those_remain_that_cover_most_in_their_order() -> None:
    model = some(2 * ROWS + 300)
    model.sh0[:, 0] = np.arange(len(model))
    reduced = Reduced(InMemory(model), ROWS)
    found = all_of(reduced)
    assert len(found) == reduced.count == ROWS
    assert found.opacities.min() > 0
    rows = found.sh0[:, 0].astype(np.int64)
    assert (np.diff(rows) > 0).all()
    assert (model.means[rows] == found.means).all()


def test_what_is_large_or_near_covers_more() -> None:
    model = some(9)
    model.means[:] = 0
    model.means[:, 0] = [1, 2, 3, 4, 5, 6, 7, 8, 100]  # the last is far from the median
    model.opacities[:] = 0
    model.scales[:] = -1
    assert 100 not in all_of(Reduced(InMemory(model), 8)).means[:, 0]
    model.scales[8] = 9
    assert 100 in all_of(Reduced(InMemory(model), 1)).means[:, 0]


def test_a_model_in_one_point_has_an_extent() -> None:
    model = some(5)
    model.means[:] = model.means[0]
    middle, radius = extent(InMemory(model))
    assert np.allclose(middle, model.means[0])
    assert radius == 1
    assert len(all_of(Reduced(InMemory(model), 2))) == 2
    assert len(all_of(Reduced(InMemory(model), 5))) == 5
