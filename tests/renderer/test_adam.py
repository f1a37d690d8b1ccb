"""Adam against torch.optim.Adam."""

import pytest
import torch

from panolog.renderer.adam import adam_


def test_it_is_torchs_adam() -> None:
    rng = torch.Generator().manual_seed(0)
    ours = torch.randn(50, 3, generator=rng)
    theirs = ours.clone().requires_grad_()
    mean, square = torch.zeros_like(ours), torch.zeros_like(ours)
    optimizer = torch.optim.Adam([theirs], lr=0.01, eps=1e-15)
    for step in range(1, 20):
        gradient = torch.randn(50, 3, generator=rng)
        theirs.grad = gradient.clone()
        optimizer.step()
        adam_(ours, gradient, mean, square, lr=0.01, step=step)
    assert torch.allclose(ours, theirs, atol=1e-6)


def test_rows_beyond_those_that_take_part_keep_everything() -> None:
    parameter, gradient = torch.ones(10, 2, 3), torch.ones(10, 2, 3)
    mean, square = torch.zeros_like(parameter), torch.zeros_like(parameter)
    adam_(parameter, gradient, mean, square, lr=0.1, step=1, rows=4)
    assert (parameter[:4] < 1).all() and (parameter[4:] == 1).all()
    assert not mean[4:].any() and not square[4:].any()


def test_a_gradient_of_zero_moves_nothing() -> None:
    parameter = torch.ones(4)
    adam_(parameter, torch.zeros(4), torch.zeros(4), torch.zeros(4), lr=0.1, step=1)
    assert (parameter == 1).all()


def test_shapes_that_do_not_fit_are_refused() -> None:
    with pytest.raises(ValueError, match="one shape"):
        adam_(torch.ones(4), torch.ones(5), torch.ones(4), torch.ones(4), lr=0.1, step=1)


def test_steps_and_rows_out_of_range_are_refused() -> None:
    one = torch.ones(4)
    for step, rows in ((0, None), (1, 5), (1, -1)):
        with pytest.raises(ValueError, match="must be"):
            adam_(one, one, torch.zeros(4), torch.zeros(4), lr=0.1, step=step, rows=rows)
    with pytest.raises(ValueError, match="float32"):
        adam_(one.double(), one, torch.zeros(4), torch.zeros(4), lr=0.1, step=1)
