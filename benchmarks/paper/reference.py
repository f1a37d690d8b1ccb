"""The paper's own numbers, for tables that measure the same: all of a source with the name of its table."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

BYTES = 1e6  # of the paper's MB


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


_A1 = "PanoLOG, table 1 (A1 drone)"
_X5 = "PanoLOG, table 2 (X5 handheld, without the lowest 10 % of the image)"
_PUBLIC = "PanoLOG, table 3 (means over the data set)"
SCENES: Mapping[str, Published] = {  # by a folder of a scene's path, in lower case
    "nsc": Published(
        _A1,
        (
            Row("H3DGS", 27.7787, 0.8564, 0.2457, 1002.1),
            Row("CityGaussian", 27.7340, 0.8453, 0.2609, 523.7),
            Row("DOGS", 26.8486, 0.8186, 0.2769, 1024.0),
            Row("Momentum-GS", 26.4568, 0.8311, 0.2625, 802.5),
            Row("PanoLOG (paper)", 28.1838, 0.8594, 0.2435, 463.5),
        ),
    ),
    "nsk": Published(
        _A1,
        (
            Row("H3DGS", 24.1480, 0.8154, 0.1934, 1843.2),
            Row("CityGaussian", 24.8270, 0.8176, 0.1983, 1126.4),
            Row("DOGS", 24.4606, 0.7980, 0.2174, 1536.0),
            Row("Momentum-GS", 23.9123, 0.7979, 0.1986, 1024.0),
            Row("PanoLOG (paper)", 24.6387, 0.8243, 0.1916, 544.0),
        ),
    ),
    "bax": Published(
        _X5,
        (
            Row("H3DGS", 20.7104, 0.6626, 0.3936, 7577.6),
            Row("CityGaussian", 19.8361, 0.5995, 0.4902, 418.5),
            Row("DOGS", 19.6094, 0.5745, 0.5203, 671.8),
            Row("Momentum-GS", 20.0993, 0.5999, 0.4896, 1024.0),
            Row("PanoLOG (paper)", 21.3468, 0.6656, 0.4169, 1331.2),
        ),
    ),
    "nsn": Published(
        _X5,
        (
            Row("H3DGS", 23.4464, 0.7530, 0.3018, 5734.4),
            Row("CityGaussian", 21.9492, 0.6729, 0.4221, 526.6),
            Row("DOGS", 22.6743, 0.6587, 0.4454, 774.9),
            Row("Momentum-GS", 22.9746, 0.7052, 0.3703, 1331.2),
            Row("PanoLOG (paper)", 24.6095, 0.7508, 0.3347, 766.8),
        ),
    ),
    "ricoh360": Published(
        _PUBLIC,
        (
            Row("OmniGS", 26.00, 0.828, 0.210),
            Row("3DGS", 26.26, 0.825, 0.225),
            Row("ODGS", 22.71, 0.748, 0.326),
            Row("SpaGS", 26.11, 0.832, 0.243),
            Row("PanoLOG (paper)", 26.48, 0.845, 0.183),
        ),
    ),
    "360roam": Published(
        _PUBLIC,
        (
            Row("OmniGS", 24.93, 0.800, 0.253),
            Row("3DGS", 24.98, 0.800, 0.271),
            Row("ODGS", 19.74, 0.627, 0.476),
            Row("SpaGS", 25.45, 0.814, 0.223),
            Row("PanoLOG (paper)", 25.83, 0.821, 0.222),
        ),
    ),
}
TABLES: Mapping[str, Published] = {  # by `variants.Group.source`; the paper does not name their scenes
    "ablation": Published(
        "PanoLOG, table 4",
        (
            Row("full model", 24.65, 0.827, 0.186, 667),
            Row("w/o G²PS", 24.14, 0.816, 0.194, 580),
            Row("w/o sky sphere", 24.15, 0.822, 0.195, 683),
            Row("w/o depth supervision", 24.61, 0.824, 0.191, 588),
        ),
    ),
    "threshold": Published(
        "PanoLOG, table 5",
        (
            Row("τ = 0.7", 24.61, 0.822, 0.192, 699),
            Row("τ = 0.8", 24.65, 0.827, 0.186, 667),
            Row("τ = 0.9", 24.42, 0.823, 0.190, 654),
        ),
    ),
}


def published(scene: Path) -> Published | None:
    """The paper's numbers of a scene: a folder of its path has the name of the scene or of its data set."""
    for part in reversed(scene.absolute().parts):
        if found := SCENES.get(part.lower().replace("_", "").replace("-", "")):
            return found
    return None
