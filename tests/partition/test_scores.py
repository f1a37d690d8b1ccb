from pathlib import Path

import numpy as np
import pytest
from scipy.sparse import csr_array, load_npz

from panolog.partition.scores import read_scores, write_scores
from panolog.scene.errors import InputError

SCORES = np.array([[0.0, 1.5, 0.0], [1e-300, 0.0, 2.0]])


def test_scores_survive_their_file(tmp_path: Path) -> None:
    path = tmp_path / "scores.npz"
    write_scores(path, (4, 7), SCORES)
    np.testing.assert_array_equal(read_scores(path, (4, 7), 3).toarray(), SCORES)
    np.testing.assert_array_equal(load_npz(path).toarray(), SCORES)  # with a library of others


def test_zeros_take_no_bytes(tmp_path: Path) -> None:
    scores = csr_array((np.ones(100), (np.arange(100), np.arange(100))), shape=(100, 10_000))
    write_scores(tmp_path / "scores.npz", range(100), scores)
    assert (tmp_path / "scores.npz").stat().st_size < 10_000


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"cameras": np.array([4, 8])}, "other cameras"),
        ({"indices": np.array([0, 0, 3])}, "no gradient scores"),  # outside: scipy would write there
        ({"indices": np.array([0, -1, 2])}, "no gradient scores"),
        ({"indptr": np.array([0, 1, 99])}, "no gradient scores"),
        ({"data": np.array([Path()] * 3, dtype=object)}, "no gradient scores"),  # which would be unpickled
        ({"data": None}, "no gradient scores"),
        ({"scores": np.ones((2, 4))}, "other blocks"),
    ],
)
def test_a_file_that_is_wrong_is_refused(
    tmp_path: Path, changed: dict[str, np.ndarray | None], words: str
) -> None:
    path = tmp_path / "scores.npz"
    write_scores(path, (4, 7), SCORES)
    with np.load(path) as arrays:
        parts = {name: arrays[name] for name in arrays} | changed
    np.savez(path, **{name: part for name, part in parts.items() if part is not None})
    with pytest.raises(InputError, match=words):
        read_scores(path, (4, 7), 3)


def test_something_else_is_refused(tmp_path: Path) -> None:
    (tmp_path / "scores.npz").write_bytes(b"PK\x03\x04 and no more")
    with pytest.raises(InputError, match="no gradient scores"):
        read_scores(tmp_path / "scores.npz", (0,), 1)
