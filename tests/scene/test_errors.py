"""Errors survive a process boundary, and fit on one line."""

import pickle

import pytest

from panolog.scene import errors


@pytest.mark.parametrize("kind", [kind for kind in vars(errors).values() if isinstance(kind, type)])
def test_an_error_survives_pickling(kind: type[errors.PanologError]) -> None:
    copy = pickle.loads(pickle.dumps(kind("scene/sparse/0: damaged; export it again")))
    assert (type(copy), str(copy)) == (kind, "scene/sparse/0: damaged; export it again")


def test_an_error_in_one_line() -> None:
    assert errors.in_one_line(ValueError("line 3:\n   no\tcolon ")) == "line 3: no colon"
    assert errors.in_one_line(ValueError("line 3: no colon"), 6) == "line 3"
    assert errors.in_one_line(TimeoutError()) == "TimeoutError"
