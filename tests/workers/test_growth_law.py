from dataclasses import replace

import pytest

from panolog.workers.growth_law import additions, population
from panolog.workers.training.config import DensifyConfig, TrainConfig
from panolog.workers.training.schedule import Schedule

SCHEDULE = Schedule(TrainConfig(), 1500, extent=1.0, refine=False)
PIXELS = 256 * 128


@pytest.mark.parametrize(
    ("points", "share", "pixels", "iterations", "measured"),
    [
        (19_942, 0.074, 256 * 128, 300, 27_040),  # a street
        (19_942, 0.038, 512 * 256, 1500, 42_603),
        (3_850, 0.42, 256 * 128, 300, 18_763),  # a flat
        (3_850, 0.331, 512 * 256, 1500, 73_499),
        (8_000, 0.164, 512 * 256, 300, 21_119),  # the demo's town
        (8_000, 0.268, 256 * 128, 1500, 50_669),
    ],
)
def test_the_law_holds_for_what_was_measured(
    points: int, share: float, pixels: int, iterations: int, measured: int
) -> None:
    added = additions(points, share, pixels)
    assert population(points, added, pixels, replace(SCHEDULE, iterations=iterations))[-1][
        1
    ] == pytest.approx(measured, rel=0.35)


def test_periods_last_as_long_as_the_task() -> None:
    periods = population(1000, 50.0, PIXELS, SCHEDULE)
    assert sum(count for count, _ in periods) == 1500
    assert [count for _, count in periods] == sorted(count for _, count in periods)
    assert periods[0] == (50, 1000)
    assert periods[1] == (25, 1050)


def test_growth_has_bounds() -> None:
    still, capped = (
        replace(SCHEDULE, config=TrainConfig(densify=DensifyConfig.model_validate(densify)))
        for densify in ({"until": 0}, {"max_gaussians": 1100})
    )
    assert population(1000, 50.0, PIXELS, still) == [(1500, 1000)]
    assert population(1000, 50.0, PIXELS, capped)[-1][1] == 1100
    assert population(1200, 50.0, PIXELS, capped)[-1][1] == 1200  # takes nothing away
    assert population(100, 1e6, PIXELS, SCHEDULE)[1] == (25, 150)  # few do not become many at once


def test_blocks_grow_faster_than_stage_one() -> None:
    coarse, block = SCHEDULE, replace(SCHEDULE, refine=True)
    assert population(10_000, 500, PIXELS, block)[-1][1] > population(10_000, 500, PIXELS, coarse)[-1][1]
