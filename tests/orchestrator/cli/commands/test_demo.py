"""The demo's settings: its few iterations go through all that a full run does."""

import pytest

from panolog.orchestrator.cli.commands.demo import SETTINGS
from panolog.orchestrator.runs.config import load_config
from panolog.workers.training.schedule import Schedule


@pytest.mark.parametrize("refine", [False, True])
def test_the_demo_goes_through_what_the_paper_describes(refine: bool) -> None:
    """Growth of harmonics, densification before and after an opacity reset (app. D), and a quiet end."""
    config = load_config(flags=SETTINGS)
    schedule = Schedule(config, config.iterations, 1.0, refine)
    every = range(1, config.iterations + 1)
    (reset,) = [i for i in every if schedule.resets(i)]
    densified = [i for i in every if schedule.densifies(i)]
    assert densified[0] < reset < densified[-1] < 0.7 * config.iterations
    degrees = {schedule.sh_degree(i) for i in every}
    assert degrees == ({3} if refine else {0, 1, 2, 3})
