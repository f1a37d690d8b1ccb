"""The tree keeps its rules; `python -m tests.structure` prints the violations of all of them."""

from collections.abc import Callable, Iterator

import pytest

from tests.structure import rules


@pytest.mark.parametrize("rule", rules.RULES, ids=lambda rule: str(rule.__name__))
def test_the_tree_keeps_the_rule(rule: Callable[[], Iterator[str]]) -> None:
    assert not list(rule())
