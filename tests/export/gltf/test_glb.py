"""GLB: attributes as the extension has them, by a reader of the test's own and by Khronos' validator."""

import json
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from panolog.export.gltf import glb
from panolog.export.gltf.glb import write_glb
from panolog.export.splats import InMemory, Splats
from panolog.export.spz import decode
from panolog.scene.errors import FormatError
from tests.export.gaussians import matched, scattered
from tests.export.gltf.reading import read_glb
from tests.export.peers import node, peer

EXTENSION = "KHR_gaussian_splatting"
SPZ = "KHR_gaussian_splatting_compression_spz_2"


def far(count: int, degree: int = 3) -> Splats:
    """Gaussians that float32 and SPZ hold only around an origin of their own."""
    splats = scattered(count, degree)
    return Splats(**splats.columns() | {"means": splats.means + np.array([10_000, 20, -30_000], np.float32)})


def test_compressed(tmp_path: Path) -> None:
    splats = far(500)
    write_glb(tmp_path / "a.glb", InMemory(splats))
    found = read_glb(tmp_path / "a.glb")
    assert found.document["extensionsUsed"] == found.document["extensionsRequired"] == [EXTENSION, SPZ]
    assert found.primitive["extensions"][EXTENSION]["extensions"] == {SPZ: {"bufferView": 0}}
    inside = decode(BytesIO(found.view(0)), "a.glb")
    means = (inside.means + found.matrix[:3, 3]).astype(np.float32)
    was = matched(splats, means)
    assert np.abs(means - was.means).max() < 0.003  # float32 has 2 mm at 30 km
    np.testing.assert_array_equal(found.matrix[:3, 3], np.round(found.matrix[:3, 3]))
    accessors, attributes = found.document["accessors"], found.primitive["attributes"]
    for side in ("min", "max"):
        corner = getattr(inside.means, side)(axis=0)
        np.testing.assert_allclose(accessors[attributes["POSITION"]][side], corner, atol=0.003)
    assert accessors[attributes["COLOR_0"]]["normalized"] and found.primitive["mode"] == 0
    assert {a["count"] for a in found.document["accessors"]} == {500}
    assert not any("bufferView" in a for a in found.document["accessors"])
    assert {f"{EXTENSION}:SH_DEGREE_3_COEF_6", "COLOR_0"} < set(found.primitive["attributes"])


def test_what_does_not_fit_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(glb, "_MOST", 1000)
    with pytest.raises(FormatError, match="may have 1000"):
        write_glb(tmp_path / "c", InMemory(scattered(100)))
    assert not list(tmp_path.iterdir())


def issues(path: Path, *plain: str) -> list[dict[str, Any]]:
    """What Khronos' validator says, but that it does not know the extensions."""
    done = node(Path(__file__).with_name("validate.cjs"), peer("gltf-validator").parent, path, *plain)
    assert done.returncode == 0, done.stderr
    found: list[dict[str, Any]] = json.loads(done.stdout)["issues"]["messages"]
    return [issue for issue in found if issue["code"] != "UNSUPPORTED_EXTENSION"]


@pytest.mark.system
@pytest.mark.nightly
def test_khronos_validator(tmp_path: Path) -> None:
    path = tmp_path / "a.glb"
    write_glb(path, InMemory(far(1000)))
    for issue in issues(path):  # of the extension's semantics, which it does not know
        unused = issue["code"] == "UNUSED_OBJECT" and issue["pointer"] == "/bufferViews/0"
        unknown = issue["code"] == "MESH_PRIMITIVE_INVALID_ATTRIBUTE" and f"/{EXTENSION}:" in issue["pointer"]
        assert unused or unknown, issue
    assert [issue for issue in issues(path, "plain") if issue["code"] != "UNUSED_OBJECT"] == []
