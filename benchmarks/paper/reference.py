"""The paper's own numbers and settings by scene, for tables that measure the same.

`reference.csv` has the numbers, with the name of each table.
"""

import csv
import json
from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

BYTES = 2**20  # of the paper's MB: it has sizes such as 1024.0 and 7577.6
CROPPED: Mapping[str, float] = {"bax": 0.1, "nsn": 0.1}  # part of the height, at the bottom: hand-held
DATA_SETS = frozenset({"ricoh360", "360roam"})  # for which it has means over their scenes alone
_FILE = Path(__file__).with_name("reference.csv")


@dataclass(frozen=True)
class Row:
    """A method on a scene. LPIPS with VGG; size in MiB, None where the paper has none."""

    source: str  # one of the paper's tables
    method: str
    psnr: float  # dB
    ssim: float
    lpips: float
    size: float | None


def _read(path: Path) -> dict[str, list[Row]]:
    """By a folder of a scene's path in lower case, or by "table/" and `variants.Group.source`."""
    found = defaultdict[str, list[Row]](list)
    with path.open(newline="") as file:
        for line in csv.DictReader(file):
            figures = (json.loads(line[key] or "null") for key in ("psnr", "ssim", "lpips", "size"))
            found[line["of"]].append(Row(line["source"], line["method"], *figures))
    return dict(found)


PUBLISHED: Mapping[str, list[Row]] = _read(_FILE)


def name_of(scene: Path) -> str:
    """The name in PUBLISHED of a scene or its data set, which a folder of its path has; "" if none has."""
    names = (part.lower().replace("_", "").replace("-", "") for part in reversed(scene.absolute().parts))
    return next((name for name in names if name in PUBLISHED), "")
