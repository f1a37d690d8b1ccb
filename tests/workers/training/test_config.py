"""The config: nothing infinite or contradictory; tests/orchestrator/runs/test_config.py has the rest."""

import math

import pytest
from pydantic import ValidationError

from panolog.workers.training.config import TrainConfig

ENDLESS = [{"near": math.inf}, {"cache": {"memory": math.inf}}, {"sky": {"kappa": math.inf}}]


@pytest.mark.parametrize("wrong", [{"loss": {"lambda_ssim": 1.5}}, *ENDLESS])
def test_impossible_settings_are_refused(wrong: dict[str, object]) -> None:
    with pytest.raises(ValidationError):
        TrainConfig.model_validate(wrong)


def test_absolute_gradients_are_of_affine_splats() -> None:
    with pytest.raises(ValidationError, match="of affine splats: set it to 0, or projection to affine"):
        TrainConfig.model_validate({"projection": "exact", "densify": {"split_gradient": 4e-4}})


@pytest.mark.parametrize("name", ["optimizer.least_pixels", "optimizer.largest", "sky.sharp"])
def test_bounds_of_sizes_need_distances(name: str) -> None:
    group, key = name.split(".")
    with pytest.raises(ValidationError, match=f"{name} needs distances: set it to 0, or "):
        TrainConfig.model_validate({group: {key: 1}})
