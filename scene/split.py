"""Which panoramas train and which are held out."""

from collections.abc import Sequence
from pathlib import Path

from panolog.scene.errors import SceneError

HOLD_OUT = 8  # every 8th by name is test: the 7:1 of the paper


def read_split(root: Path, stems: Sequence[str]) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """(train, test): rows of `stems`, ascending.

    `root/train.txt` and `root/test.txt` hold one stem a line. With one of the two, the other set is the rest;
    with both, what neither names is left out; with none, every 8th is test.

    Args:
        root: the scene's folder.
        stems: names of the panoramas without extension, sorted.

    Raises:
        SceneError: a file is not UTF-8 or names what the scene does not have, a panorama is in both, or a set
            is empty.
    """
    rows = {stem: row for row, stem in enumerate(stems)}
    train, test = (_read(root / name, rows) for name in ("train.txt", "test.txt"))
    if train is None and test is None:
        test = set(range(0, len(stems), HOLD_OUT))
    if test is None:
        test = set(rows.values()) - (train or set())
    if train is None:
        train = set(rows.values()) - test
    if both := sorted(train & test):
        raise SceneError(f"{root}: {stems[both[0]]} is in train.txt and in test.txt; remove it from one")
    for name, members in (("test", test), ("train", train)):
        if not members:
            raise SceneError(f"{root}: the {name} split is empty; name at least one panorama in {name}.txt")
    return tuple(sorted(train)), tuple(sorted(test))


def _read(path: Path, rows: dict[str, int]) -> set[int] | None:
    """The rows that a split file names, as stems or with their extension; None without the file."""
    if not path.is_file():
        return None
    try:
        text = path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError as error:
        raise SceneError(f"{path}: is not UTF-8; save it so") from error
    found = set()
    for line in text.splitlines():
        if name := line.strip():
            row = rows.get(name, rows.get(str(Path(name).with_suffix(""))))
            if row is None:
                raise SceneError(f"{path}: {name} is no panorama of this scene; remove that line")
            found.add(row)
    return found
