"""The rasterizer's benchmark: what it times is a real iteration that leaves the model as it was."""

from collections.abc import Iterator
from dataclasses import astuple

import pytest
import torch

from benchmarks.rasterizer import HEAD, Trainer, benchmark, parse, random_case


@pytest.fixture(autouse=True)
def same_threads() -> Iterator[None]:
    before = torch.get_num_threads()
    yield
    torch.set_num_threads(before)


def test_one_row_for_each_number_of_threads() -> None:
    rows = list(benchmark([random_case(200, 64)], [1, 2], repeats=1))
    assert [row.threads for row in rows] == [1, 2]
    assert rows[0].pairs == rows[1].pairs > 0
    assert all(milliseconds > 0 for row in rows for milliseconds in astuple(row.times))
    assert rows[0].rates()["forward_pairs"] == pytest.approx(rows[0].pairs / rows[0].times.forward * 1e3)
    assert len(rows[0].cells()) == len(HEAD)


def test_an_iteration_has_gradients_and_leaves_the_model() -> None:
    case = random_case(200, 64)
    trainer = Trainer(case, case.shots[0])
    trainer.iteration()
    assert trainer.trainee.exp_avg["means"].abs().sum() > 0
    for name, tensor in trainer.trainee.gaussians.tensors().items():
        assert torch.equal(tensor, getattr(case.gaussians, name)), name


def test_a_model_needs_its_scene(capsys: pytest.CaptureFixture[str]) -> None:
    assert parse(["--width", "64,128"]).width == [64, 128]
    with pytest.raises(SystemExit):
        parse(["--model", "model.ply"])
    assert "go together" in capsys.readouterr().err
