import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from panolog.partition.bounds import margin
from panolog.partition.districts import make_districts

RANDOM = np.random.default_rng(0)
FIELD = np.concatenate([RANDOM.uniform(0, 200, (400, 2)), RANDOM.normal(2, 0.1, (400, 1))], axis=1)


def test_one_district_has_all_cameras() -> None:
    assert make_districts(FIELD, FIELD, 5.0, 1).cameras.all()


@pytest.mark.parametrize("count", [2, 4, 9])
def test_each_camera_trains_its_own_district_and_those_within_the_margin(count: int) -> None:
    districts = make_districts(FIELD, FIELD, 2.0, count)
    assert districts.count == count
    own = np.stack([districts.cell(district).contains(FIELD) for district in range(count)])
    assert (own.sum(axis=0) == 1).all()
    assert not (own & ~districts.cameras).any()
    away = np.array(
        [[np.linalg.norm(FIELD[mine] - center, axis=1).min() for center in FIELD] for mine in own]
    )
    near = margin(FIELD, 2.0)
    assert away[districts.cameras].max() < 6 * near  # a district's cameras do not reach its very edge
    assert districts.cameras[away < near / 2].all()


def test_districts_have_a_part_of_the_cameras_each() -> None:
    districts = make_districts(FIELD, FIELD, 1.0, 8)
    assert districts.cameras.sum(axis=1).max() < 0.35 * len(FIELD)


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(3, 40), st.integers(1, 12), st.floats(0, 8))
def test_every_camera_trains_the_district_that_it_stands_in(
    seed: int, cameras: int, count: int, rho_tri: float
) -> None:
    random = np.random.default_rng(seed)
    centers = random.normal(size=(4, 3))[random.integers(0, 4, cameras)] + random.normal(0, 0.1, (cameras, 3))
    districts = make_districts(centers, centers[:0], rho_tri, count)
    own = np.stack([districts.cell(district).contains(centers) for district in range(districts.count)])
    assert not (own & ~districts.cameras).any()
