"""The paper's own numbers, for tables that measure the same: `reference.csv`, with the name of each table."""

import csv
import json
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path

BYTES = 1e6  # of the paper's MB
_FILE = Path(__file__).with_name("reference.csv")


@dataclass(frozen=True)
class Row:
    """A method on a scene. LPIPS with VGG; size in MB, None where the paper has none."""

    method: str
    psnr: float  # dB
    ssim: float
    lpips: float
    size: float | None = None


@dataclass(frozen=True)
class Published:
    """Rows of one of the paper's tables."""

    source: str
    rows: tuple[Row, ...]


def _read(path: Path) -> dict[str, Published]:
    """By a folder of a scene's path in lower case, or by "table/" and `variants.Group.source`."""
    with path.open(newline="") as file:
        lines = list(csv.DictReader(file))
    return {
        name: Published(
            rows[0]["source"],
            tuple(
                Row(
                    row["method"],
                    *(json.loads(row[key] or "null") for key in ("psnr", "ssim", "lpips", "size")),
                )
                for row in rows
            ),
        )
        for name, group in groupby(lines, lambda line: line["of"])
        if (rows := list(group))
    }


PUBLISHED: Mapping[str, Published] = _read(_FILE)


def published(scene: Path) -> Published | None:
    """The paper's numbers of a scene: a folder of its path has the name of the scene or of its data set."""
    for part in reversed(scene.absolute().parts):
        if found := PUBLISHED.get(part.lower().replace("_", "").replace("-", "")):
            return found
    return None
