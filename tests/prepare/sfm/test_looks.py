import numpy as np
from numpy.typing import NDArray

from panolog.prepare.sfm.looks import _matches


def _words(random: np.random.Generator, count: int) -> NDArray[np.float32]:
    words = random.uniform(0, 1, (count, 128)) ** 4
    whole = np.rint(512 * words / np.linalg.norm(words, axis=1, keepdims=True))
    return np.asarray(whole, np.float32)


def test_shared_features_are_counted() -> None:
    random = np.random.default_rng(0)
    one, other = _words(random, 200), _words(random, 180)
    other[:60] = np.maximum(one[40:100] + random.integers(-6, 7, (60, 128)), 0)
    assert 55 <= _matches(one @ other.T) <= 65


def test_features_that_repeat_in_one_panorama_do_not_count() -> None:
    random = np.random.default_rng(1)
    one = _words(random, 100)
    assert _matches(one @ np.concatenate([one, one]).T) == 0


def test_too_few_features() -> None:
    one = _words(np.random.default_rng(2), 1)
    assert _matches(one @ one.T) == 0
    assert _matches(one @ one[:0].T) == 0
