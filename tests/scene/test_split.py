from pathlib import Path

import pytest

from panolog.scene.errors import InputError
from panolog.scene.split import read_split

STEMS = [f"walk/{i:02d}" for i in range(17)]


def test_every_eighth_is_test(tmp_path: Path) -> None:
    train, test = read_split(tmp_path, STEMS)
    assert test == (0, 8, 16)
    assert sorted(train + test) == list(range(17))


@pytest.mark.parametrize(
    "files, train, test",
    [
        ({"test": "walk/03\nwalk/01.jpg\n\n"}, (0, 2, *range(4, 17)), (1, 3)),
        ({"train": "\ufeffwalk/00\r\nwalk/01\r\n"}, (0, 1), tuple(range(2, 17))),
        ({"train": "walk/05", "test": "walk/04"}, (5,), (4,)),
    ],
)
def test_files_decide(
    tmp_path: Path, files: dict[str, str], train: tuple[int, ...], test: tuple[int, ...]
) -> None:
    for name, text in files.items():
        (tmp_path / f"{name}.txt").write_text(text, encoding="utf-8")
    assert read_split(tmp_path, STEMS) == (train, test)


@pytest.mark.parametrize(
    "files, complaint",
    [
        ({"test": ""}, "test split is empty"),
        ({"train": "\n"}, "train split is empty"),
        ({"train": "\n".join(STEMS)}, "test split is empty"),
        ({"test": "walk/99"}, "walk/99 is no panorama"),
        ({"train": "walk/01", "test": "walk/01"}, "in train.txt and in test.txt"),
    ],
)
def test_a_wrong_split_is_refused(tmp_path: Path, files: dict[str, str], complaint: str) -> None:
    for name, text in files.items():
        (tmp_path / f"{name}.txt").write_text(text)
    with pytest.raises(InputError, match=complaint):
        read_split(tmp_path, STEMS)
