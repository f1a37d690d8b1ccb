"""The exception tree: which error is which, and that each survives a process boundary."""

import pickle

import pytest

from panolog.scene import errors

PARENTS = {
    errors.PanologError: Exception,
    errors.InputError: errors.PanologError,
    errors.SceneError: errors.InputError,
    errors.ImageError: errors.SceneError,
    errors.PlyError: errors.InputError,
    errors.FormatError: errors.InputError,
    errors.ConfigError: errors.InputError,
    errors.StoreError: errors.InputError,
    errors.StoreLostError: errors.RunError,
    errors.DeviceError: errors.InputError,
    errors.ClusterError: errors.InputError,
    errors.ClusterLostError: errors.RunError,
    errors.RunFolderError: errors.InputError,
    errors.RunLockedError: errors.RunFolderError,
    errors.QueueError: errors.InputError,
    errors.RunError: errors.PanologError,
}


def test_the_table_is_the_whole_tree() -> None:
    assert set(PARENTS) == {kind for kind in vars(errors).values() if isinstance(kind, type)}
    assert {kind: kind.__bases__ for kind in PARENTS} == {kind: (base,) for kind, base in PARENTS.items()}


@pytest.mark.parametrize("kind", PARENTS, ids=lambda kind: kind.__name__)
def test_an_error_survives_pickling(kind: type[errors.PanologError]) -> None:
    copy = pickle.loads(pickle.dumps(kind("scene/sparse/0: damaged; export it again")))
    assert (type(copy), str(copy)) == (kind, "scene/sparse/0: damaged; export it again")


def test_an_error_in_one_line() -> None:
    assert errors.in_one_line(ValueError("line 3:\n   no\tcolon ")) == "line 3: no colon"
    assert errors.in_one_line(ValueError("line 3: no colon"), 6) == "line 3"
    assert errors.in_one_line(TimeoutError()) == "TimeoutError"
