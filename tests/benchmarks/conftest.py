"""Benchmarks set the number of threads; other tests must not see it."""

from collections.abc import Iterator

import pytest
import torch

from panolog.renderer import ops


@pytest.fixture(autouse=True)
def same_threads() -> Iterator[None]:
    before = torch.get_num_threads()
    yield
    torch.set_num_threads(before)
    ops.use_threads(None)
