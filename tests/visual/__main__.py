"""Writes the reference pictures anew: python -m tests.visual [--sheet FOLDER] [NAME...]."""

import argparse
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory

import cv2

from tests.visual.browser import fixed_browser, fixed_page, screenshot, wait_until_quiet
from tests.visual.compare import Picture, path_of, write
from tests.visual.pages import SHOTS, show, site


def pictures(names: list[str]) -> Iterator[tuple[str, Picture]]:
    """All pictures by name, or those whose name begins with one of `names`."""
    starts = tuple(names) or ("",)
    with (
        TemporaryDirectory() as folder,
        site(Path(folder)) as here,
        fixed_browser() as browser,
        fixed_page(browser, here.root) as page,
    ):
        for shot in SHOTS:
            if any(f"{shot.name}-{view}".startswith(starts) for view in shot.views):
                shot.open(here, page)
            for view in shot.views:
                if f"{shot.name}-{view}".startswith(starts):
                    show(page, view)
                    wait_until_quiet(page, 2_000)
                    yield f"{shot.name}-{view}", screenshot(page, whole=shot.whole)


def main() -> None:
    """Writes them."""
    parser = argparse.ArgumentParser(prog="python -m tests.visual", description=__doc__)
    parser.add_argument("names", nargs="*", metavar="NAME", help="only pictures whose name begins so")
    parser.add_argument(
        "--sheet", type=Path, help="write them here, in pieces that fit a screen; no references"
    )
    arguments = parser.parse_args()
    for name, picture in pictures(arguments.names):
        if arguments.sheet is None:
            write(name, picture)
            print(path_of(name))
        else:
            arguments.sheet.mkdir(parents=True, exist_ok=True)
            for number, top in enumerate(range(0, len(picture), 1400)):
                path = arguments.sheet / f"{name}-{number}.png"
                cv2.imwrite(str(path), picture[top : top + 1500])
                print(path)


if __name__ == "__main__":
    main()
