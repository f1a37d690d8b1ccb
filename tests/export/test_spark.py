"""SPZ in Spark, in a real browser: it reads the bytes itself, in Rust."""

from pathlib import Path

import numpy as np
import pytest

from panolog.export.splats import InMemory
from panolog.export.spz import read_spz, write_spz
from tests.export.browser import serving, software_page
from tests.export.gaussians import C0, scattered
from tests.export.peers import peer

pytestmark = [pytest.mark.system, pytest.mark.nightly]

PAGE = """<!doctype html>
<link rel="icon" href="data:," />
<script type="importmap">
  {"imports": {
    "three": "./three/build/three.module.js", "three/addons/": "./three/examples/jsm/",
    "spark": "./spark/dist/spark.module.js"
  }}
</script>
<script type="module">
  import {SplatMesh} from "spark";
  window.splats = async (url) => {
    const mesh = new SplatMesh({url}), rows = [];
    await mesh.initialized;
    mesh.forEachSplat((_, center, scales, rotation, opacity, color) =>
      rows.push([center, scales, rotation, [opacity], color].flatMap((value) => [...value])));
    return rows;
  };
</script>
"""


def test_spark_reads_spz(tmp_path: Path) -> None:
    """Spark keeps positions as float16, and the rest in bytes: differences are its own quantisation.

    Spark 2.2 does not know version 4.
    """
    splats = scattered(2001, 2, extent=8, size=0.002)  # small: the SPZ has more than 12 fractional bits
    write_spz(tmp_path / "a.spz", InMemory(splats))
    ours = read_spz(tmp_path / "a.spz")
    (tmp_path / "index.html").write_text(PAGE)
    for name, package in (("three", "three"), ("spark", "@sparkjsdev/spark")):
        (tmp_path / name).symlink_to(peer(package))
    with serving(tmp_path) as url, software_page(url) as page:
        page.wait_for_function("window.splats")
        rows = np.array(page.evaluate("window.splats('a.spz')"))
    assert len(rows) == 2001
    np.testing.assert_allclose(rows[:, :3], ours.means, rtol=2**-11, atol=1e-4)
    np.testing.assert_allclose(np.log(rows[:, 3:6]), ours.scales, atol=0.1)
    cosine = np.abs((rows[:, [9, 6, 7, 8]] * ours.quats).sum(axis=1))
    assert np.degrees(2 * np.arccos(cosine.clip(0, 1))).max() < 3
    np.testing.assert_allclose(rows[:, 10], 1 / (1 + np.exp(-ours.opacities)), atol=0.01)
    np.testing.assert_allclose(rows[:, 11:], (ours.sh0 * C0 + 0.5).clip(0, 1), atol=0.01)
