"""The config: the paper's values, nothing unknown, every field explained."""

import math

import pytest
from pydantic import BaseModel, ValidationError

from panolog.workers.training.config import TrainConfig


def test_defaults_are_the_papers() -> None:
    config = TrainConfig()
    assert (config.sky.kappa, config.sky.count) == (10, 100_000)
    assert (config.depth.w0, config.depth.wT) == (0.5, 0.01)
    assert config.loss.lambda_ssim == 0.2
    assert (config.optimizer.position, config.optimizer.sh0) == (1.6e-4, 2.5e-3)
    assert (config.densify.every, config.densify.gradient, config.reset.every) == (100, 2e-4, 3000)


@pytest.mark.parametrize("wrong", [{"skye": {}}, {"sky": {"kapa": 3}}, {"loss": {"lambda_ssim": 1.5}}])
def test_unknown_and_impossible_settings_are_refused(wrong: dict[str, object]) -> None:
    with pytest.raises(ValidationError):
        TrainConfig.model_validate(wrong)


@pytest.mark.parametrize(
    "endless", [{"near": math.inf}, {"cache": {"memory": math.inf}}, {"sky": {"kappa": math.inf}}]
)
def test_infinite_settings_are_refused(endless: dict[str, object]) -> None:
    with pytest.raises(ValidationError, match="finite"):
        TrainConfig.model_validate(endless)


def test_nothing_changes_after_validation() -> None:
    with pytest.raises(ValidationError):
        TrainConfig().sky.kappa = 3


def test_every_field_is_described() -> None:
    for name, group in TrainConfig.model_fields.items():
        value = getattr(TrainConfig(), name)
        fields = type(value).model_fields if isinstance(value, BaseModel) else {name: group}
        for key, field in fields.items():
            assert field.description and not field.is_required(), f"{name}.{key}"
