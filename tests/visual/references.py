"""The reference pictures, one for each page, width and theme."""

from pathlib import Path

import cv2

from tests.visual.compare import Picture, compare, expand, reduce, side_by_side

FOLDER = Path(__file__).with_name("references")


def path_of(name: str) -> Path:
    """Where a reference is."""
    return FOLDER / f"{name}.webp"


def write(name: str, picture: Picture) -> None:
    """Writes a reference."""
    FOLDER.mkdir(exist_ok=True)
    path_of(name).write_bytes(reduce(picture))


def difference(name: str, picture: Picture, folder: Path) -> str:
    """How a picture differs from its reference, and where both are shown; empty if it does not.

    Args: folder, for that picture.
    """
    renew = f"`python -m tests.visual {name}` makes it anew"
    if not path_of(name).is_file():
        return f"there is no {path_of(name)}: {renew}"
    reference, reduced = expand(path_of(name).read_bytes()), expand(reduce(picture))
    comparison = compare(reference, reduced)
    if not comparison.reason:
        return ""
    both = folder / f"{name}.png"
    cv2.imwrite(str(both), side_by_side(reference, reduced, comparison))
    return f"{comparison.reason}: see {both}; if it is meant to look so, {renew}"
