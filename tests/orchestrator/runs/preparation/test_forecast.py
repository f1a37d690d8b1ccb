"""What is said of the time of a preparation and of the training after it, before either is measured."""

from typing import Any

import pytest

from panolog.orchestrator.runs.config import RunConfig
from panolog.orchestrator.runs.preparation import forecast
from panolog.orchestrator.runs.preparation.settings import Settings, Step


@pytest.fixture(autouse=True)
def _one_core(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(forecast, "cores", lambda: 1)


def settings(panoramas: int, width: int, **more: Any) -> Settings:
    given = {"source": "walk", "video": False, "nadir": 9, "static": True}
    return Settings.model_validate(given | {"panoramas": panoramas, "width": width} | more)


def seconds(*given: Any, chosen: int | None = None, **more: Any) -> float:
    return sum(forecast.parts_of(settings(*given, **more), chosen).values())


def test_the_parts_are_those_of_the_steps() -> None:
    parts = forecast.parts_of(settings(9, 2048), None)
    assert {step for step, _ in parts} == {Step.MASKS, Step.SFM, Step.CHECK}
    assert all(took >= 0 for took in parts.values())


@pytest.mark.parametrize(("panoramas", "width", "measured"), [(11, 2048, 54.0), (64, 1024, 124.0)])
def test_it_is_near_what_two_captures_took(panoramas: int, width: int, measured: float) -> None:
    """A flat and a street, without masks and check."""
    parts = forecast.parts_of(settings(panoramas, width), None)
    found = sum(took for (step, _), took in parts.items() if step is Step.SFM)
    assert found == pytest.approx(measured, rel=0.2)


def test_a_video_counts_its_frames_until_they_are_chosen() -> None:
    assert seconds(9000, 1024, video=True) > seconds(9000, 1024, video=True, chosen=40)
    assert seconds(9000, 1024, video=True, chosen=40) > seconds(40, 1024)


def test_networks_take_time() -> None:
    plain = seconds(40, 1024)
    assert seconds(40, 1024, mask_model="m") > plain < seconds(40, 1024, depth_model="m")


def test_a_training_takes_longer_with_more_of_anything() -> None:
    def took(of: int = 1024, **given: Any) -> float:
        settings = {"device": "cpu", "iterations": 1000} | given
        return forecast.training(RunConfig.model_validate(settings), of)

    assert took() > took(refine=False) and took(blocks="4") > took() == took(blocks="auto")
    assert took(iterations=2000) > took() > took(width=512) == took(512)
    assert took(device="cuda") < took() / 10
