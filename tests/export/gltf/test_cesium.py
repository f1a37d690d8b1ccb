"""3D Tiles in CesiumJS, in a real browser: coloured Gaussians where they should be on the earth."""

import gzip
import shutil
from collections.abc import Iterator
from dataclasses import replace
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from panolog.export.earth import enu_to_ecef
from panolog.export.gltf.tiles import write_tiles
from panolog.export.splats import InMemory, Splats
from tests.export.browser import serving, software_page
from tests.export.gaussians import Triple, cluster, scattered
from tests.export.gltf.reading import read_glb
from tests.export.peers import peer

pytestmark = [pytest.mark.system, pytest.mark.nightly]

PLACE = (48.137, 11.575, 520.0)  # latitude, longitude, height
EAST, NORTH, UP, TINY = (10.0, 0.0, 0.0), (0.0, 10.0, 0.0), (0.0, 0.0, 10.0), (0.0, 0.0, 0.0)
PAGE = Path(__file__).with_name("cesium.html")


@pytest.fixture
def served(tmp_path: Path) -> Iterator[tuple[Path, str]]:
    """A folder, and where it is served, with CesiumJS."""
    (tmp_path / "cesium").symlink_to(peer("cesium") / "Build" / "Cesium")
    shutil.copy(PAGE, tmp_path / "index.html")
    with serving(tmp_path) as url:
        yield tmp_path, url


def y_up(place: Triple) -> Triple:
    """Of east, north and up."""
    return place[0], place[2], -place[1]


def looked_at(url: str, heading: float, distance: float = 45) -> tuple[NDArray[np.uint8], dict[str, Any]]:
    """A picture from above, and what the page says. Args: heading in degrees, 0 = north; distance in m."""
    with software_page(url) as page:
        found = page.evaluate("(given) => show(given)", [*PLACE, heading, distance, [TINY, EAST, NORTH, UP]])
        picture = page.screenshot()
    assert found["errors"] == []
    return np.asarray(Image.open(BytesIO(picture)).convert("RGB")), found


def seen(picture: NDArray[np.uint8], at: list[float]) -> NDArray[np.float64]:
    """(3,) the mean colour of 5×5 pixels."""
    x, y = (round(coordinate) for coordinate in at)
    return np.asarray(picture[y - 2 : y + 3, x - 2 : x + 3].reshape(-1, 3).mean(axis=0))


def test_gaussians_are_where_they_should_be_on_the_earth(served: tuple[Path, str]) -> None:
    """CesiumJS's own geodesy says where: its ENU frame at the place, and its projection to the window.

    The cluster in the middle is of Gaussians too small to be seen, for which the SPZ has more than 12
    fractional bits; the one in the north is red if it is seen from the south, and blue from the north.
    """
    folder, url = served
    north = cluster(y_up(NORTH), (0.5, 0, 0.5))
    north.shN[:, 1] = np.array([-0.9, 0, 0.9])  # of z, which points to the south
    tiny = cluster(y_up(TINY), (1, 1, 1), spread=0.001)
    parts = [tiny, cluster(y_up(EAST), (1, 1, 0)), north, cluster(y_up(UP), (0, 1, 0))]
    write_tiles(folder / "tiles", InMemory(Splats.joined(parts)), to_ecef=enu_to_ecef(*PLACE))
    (glb,) = (folder / "tiles").glob("*.glb")
    assert gzip.decompress(read_glb(glb).view(0))[13] == 15
    for heading, color in ((20, (220, 0, 35)), (160, (35, 0, 220))):
        picture, found = looked_at(url, heading)
        middle, *at = found["at"]
        np.testing.assert_allclose(middle, [400, 300], atol=0.01)
        expected = [(255, 255, 0), color, (0, 255, 0)]
        for place, shade in zip(at, expected, strict=True):
            assert np.abs(seen(picture, place) - shade).max() < 25, (heading, place, shade)
        lit = picture.max(axis=2) > 40
        near = np.zeros_like(lit)
        for x, y in at:
            near[max(0, int(y) - 45) : int(y) + 45, max(0, int(x) - 45) : int(x) + 45] = True
        assert lit.sum() > 1500 and not (lit & ~near).any()


def test_levels_of_detail_are_shown_at_their_distance(served: tuple[Path, str]) -> None:
    """One level of each leaf: nearby the finest, from 5 km the coarsest, which is not nothing."""
    folder, url = served
    splats = scattered(9000, 1, extent=1, size=0.3)
    splats = replace(splats, means=splats.means * np.array([100, 5, 20], np.float32))
    write_tiles(folder / "tiles", InMemory(splats), to_ecef=enu_to_ecef(*PLACE), side=60, levels=3)
    _, found = looked_at(url, 0)
    leaves = [name.partition("-")[0] for name in found["selected"]]
    assert len(leaves) > 1 and len(set(leaves)) == len(leaves)
    assert all(name.endswith("-0.glb") for name in found["selected"])
    picture, found = looked_at(url, 0, 5000)
    assert len(found["selected"]) >= len(leaves)
    assert all(name.endswith("-2.glb") for name in found["selected"])
    assert picture[290:310, 390:410].max() > 40
