"""Writes a synthetic scene of any size: `python -m panolog.synthetic town|flight|city FOLDER`."""

import sys
from argparse import ArgumentParser, ArgumentTypeError
from collections.abc import Sequence
from pathlib import Path

from panolog.scene.errors import InputError
from panolog.synthetic.make import make_city, make_flight, make_town


def main(arguments: Sequence[str] | None = None) -> int:
    """Makes the scene and prints its folder; returns the exit code."""
    parser = ArgumentParser("python -m panolog.synthetic", description=__doc__)
    places = parser.add_subparsers(dest="place", required=True)
    town = places.add_parser("town", help="a walk along a street")
    flight = places.add_parser("flight", help="lanes and an orbit over blocks of houses, 25 to 60 m up")
    flight.add_argument("--blocks", type=_blocks, default=(6, 6), help="of houses, along x and y (6x6)")
    city = places.add_parser("city", help="a drive along all streets of as many blocks as that takes")
    city.add_argument("--flight", action="store_true", help="a quarter of the panoramas are from above")
    for place, panoramas, points in ((town, 28, 8_000), (flight, 96, 30_000), (city, 300, None)):
        place.add_argument("folder", type=Path)
        place.add_argument("--panoramas", type=int, default=panoramas, help=f"how many ({panoramas})")
        place.add_argument("--width", type=int, default=512, help="of a panorama in pixels (512)")
        number = points or "250 for each panorama"
        place.add_argument("--points", type=int, default=points, help=f"of the sparse cloud ({number})")
        place.add_argument("--between", action="store_true", help="also panoramas between these, held out")
        place.add_argument("--seed", type=int, default=0, help="of houses, path and cloud (0)")
    given = vars(parser.parse_args(arguments))
    make = {"town": make_town, "flight": make_flight, "city": make_city}[given.pop("place")]
    try:
        print(make(given.pop("folder"), **given))
    except (InputError, OSError) as error:
        print(f"panolog: {error}", file=sys.stderr)
        return 2
    return 0


def _blocks(text: str) -> tuple[int, int]:
    columns, _, rows = text.partition("x")
    if not (columns.isdecimal() and rows.isdecimal()):
        raise ArgumentTypeError(f"blocks are written like 6x6, not {text!r}")
    return int(columns), int(rows)


if __name__ == "__main__":
    sys.exit(main())
