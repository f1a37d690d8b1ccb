"""The comparison with OpenSplat's published figures."""

import math

import numpy as np
import pytest

from benchmarks.cases import Case, random_shot
from benchmarks.opensplat import HEAD, Row, boxes
from benchmarks.pairs import Counts
from panolog.workers.training.initialise import isotropic

COUNTS = Counts(useful=1000, evaluated=2000, entries=10, visible=10)


def test_ratios_are_those_to_the_published_rates() -> None:
    sparse = Row("sparse points", 3_850, 1, 2**19, COUNTS, 35 * 2**19, 100)
    assert sparse.rate == pytest.approx(2**19 * 10)
    assert sparse.ratio == pytest.approx(2**19 * 10 / 0.22e6)
    assert sparse.ratio_of_pairs == pytest.approx(sparse.ratio)  # as many pairs in a pixel
    assert Row("sparse points", 3_850, 2, 2**19, COUNTS, 1, 100).ratio == pytest.approx(2**19 * 10 / 0.28e6)
    assert Row("trained", 50_000, 1, 2**19, COUNTS, 1, 100).ratio == pytest.approx(2**19 * 10 / 0.064e6)
    alone = Row("trained", 50_000, 2, 2**19, COUNTS, 1, 100)
    assert alone.ratio is None and alone.ratio_of_pairs is None
    assert len(alone.cells()) == len(sparse.cells()) == len(HEAD)


def test_a_box_has_three_deviations_and_two_pixels_on_each_side() -> None:
    width, distance, sigma = 256, 2.0, 0.1
    # straight ahead of the street's camera, which looks along y: the footprint is a circle
    one = isotropic(np.array([[0.0, distance, 0.0]]), np.array([sigma]), np.ones((1, 3)), 0.5)
    pixels = math.sqrt((sigma / distance * width / (2 * math.pi)) ** 2 + 0.3)
    side = 2 * (math.ceil(3 * pixels) + 2)
    assert boxes(Case("one", one, 0.0, (random_shot(width),))) == side**2
