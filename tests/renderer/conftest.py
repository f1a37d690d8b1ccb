"""What tests of the kernels share."""

from collections.abc import Iterator

import pytest

from panolog.renderer import _core

pytest.register_assert_rewrite("tests.renderer.agreement")  # so that its failures show numbers


@pytest.fixture(params=["avx512", "avx2", "portable"])
def instruction_set(request: pytest.FixtureRequest) -> Iterator[str]:
    """Each one that this processor has."""
    before = _core.instruction_set()
    if not _core.choose_instruction_set(request.param):
        pytest.skip(f"this processor has no {request.param}")
    yield request.param
    _core.choose_instruction_set(before)
