"""Adam against torch.optim.Adam."""

from typing import Any

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
        gradient[7:9] = 0
        theirs.grad = gradient.clone()
        optimizer.step()
        adam_(ours, gradient, mean, square, lr=0.01, step=step)
    assert torch.allclose(ours, theirs, atol=1e-6)


@pytest.mark.parametrize(("count", "rows"), [(50, None), (50, 30), (40_000, None)])
def test_each_row_may_have_a_rate_of_its_own(count: int, rows: int | None, instruction_set: str) -> None:
    """Moments know nothing of it."""
    rng = torch.Generator().manual_seed(0)
    gradient, units = torch.randn(count, 3, generator=rng), torch.rand(count, generator=rng)
    found = [[torch.zeros(count, 3) for _ in range(3)] for _ in range(2)]
    for state, given in zip(found, (units, None), strict=True):
        adam_(state[0], gradient, *state[1:], lr=0.01, step=1, rows=rows, units=given)
    torch.testing.assert_close(found[0][0], units[:, None] * found[1][0])
    assert all(torch.equal(*pair) for pair in zip(found[0][1:], found[1][1:], strict=True))


def test_rows_beyond_those_that_take_part_keep_everything() -> None:
    parameter, gradient = torch.ones(10, 2, 3), torch.ones(10, 2, 3)
    mean, square = torch.zeros_like(parameter), torch.zeros_like(parameter)
    adam_(parameter, gradient, mean, square, lr=0.1, step=1, rows=4)
    assert (parameter[:4] < 1).all() and (parameter[4:] == 1).all()
    assert not mean[4:].any() and not square[4:].any()


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"gradient": torch.ones(5)}, "one shape"),
        ({"parameter": torch.ones(4).double()}, "float32"),
        ({"units": torch.ones(4, 3)}, "units must be"),
        ({"step": 0}, "must be"),
        ({"rows": 5}, "must be"),
        ({"rows": -1}, "must be"),
    ],
)
def test_what_does_not_fit_is_refused(change: dict[str, Any], words: str) -> None:
    tensors = {name: torch.ones(4) for name in ("parameter", "gradient", "exp_avg", "exp_avg_sq")}
    with pytest.raises(ValueError, match=words):
        adam_(**{**tensors, "lr": 0.1, "step": 1, **change})
