"""The config: nothing unknown or infinite, every field explained."""

import math

import pytest
from pydantic import BaseModel, ValidationError

from panolog.workers.training.config import TrainConfig

ENDLESS = [{"near": math.inf}, {"cache": {"memory": math.inf}}, {"sky": {"kappa": math.inf}}]


@pytest.mark.parametrize(
    "wrong", [{"skye": {}}, {"sky": {"kapa": 3}}, {"loss": {"lambda_ssim": 1.5}}, *ENDLESS]
)
def test_unknown_and_impossible_settings_are_refused(wrong: dict[str, object]) -> None:
    with pytest.raises(ValidationError):
        TrainConfig.model_validate(wrong)


@pytest.mark.parametrize("name", ["split_gradient", "prune_footprint"])
def test_what_measures_affine_splats_needs_them(name: str) -> None:
    with pytest.raises(
        ValidationError, match="measure affine splats: set them to 0, or projection to affine"
    ):
        TrainConfig.model_validate({"projection": "exact", "densify": {name: 20}})


def test_every_field_is_described() -> None:
    for name, group in TrainConfig.model_fields.items():
        value = getattr(TrainConfig(), name)
        fields = type(value).model_fields if isinstance(value, BaseModel) else {name: group}
        for key, field in fields.items():
            assert field.description and not field.is_required(), f"{name}.{key}"
