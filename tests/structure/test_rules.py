"""The tree keeps its rules; `python -m tests.structure` prints the violations of all of them."""

from collections.abc import Callable, Iterator

import pytest

from tests.structure import rules

KEPT = (rules.long_files, rules.import_circles)


@pytest.mark.parametrize("rule", KEPT, ids=lambda rule: str(rule.__name__))
def test_the_tree_keeps_the_rule(rule: Callable[[], Iterator[str]]) -> None:
    assert not list(rule())
