"""The picture of the packages shows the code as it is."""

from tests.structure.plan import PICTURE, picture


def test_the_picture_is_that_of_the_code() -> None:
    assert PICTURE.read_text() == picture(), "make it again: .venv/bin/python -m tests.structure.plan"
