"""GLB: attributes as the extension has them, by a reader of the test's own and by Khronos' validator."""

import json
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from panolog.export.gltf import glb
from panolog.export.gltf.glb import Compression, write_glb
from panolog.export.splats import REST, InMemory, Splats
from panolog.export.spz import decode
from panolog.scene.errors import FormatError
from tests.export.gaussians import C0, matched, scattered
from tests.export.gltf.reading import read_glb
from tests.export.peers import node, peer

EXTENSION = "KHR_gaussian_splatting"
SPZ = "KHR_gaussian_splatting_compression_spz_2"


def far(count: int, degree: int = 3) -> Splats:
    """Gaussians that float32 and SPZ hold only around an origin of their own."""
    splats = scattered(count, degree)
    return Splats(**splats.columns() | {"means": splats.means + np.array([10_000, 20, -30_000], np.float32)})


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_plain_attributes(tmp_path: Path, degree: int) -> None:
    splats = far(70_000 if degree == 0 else 500, degree)  # more than a piece
    write_glb(tmp_path / "a.glb", InMemory(splats), None)
    found = read_glb(tmp_path / "a.glb")
    assert found.document["extensionsUsed"] == [EXTENSION]
    assert found.primitive["mode"] == 0
    assert found.primitive["extensions"][EXTENSION]["kernel"] == "ellipse"
    positions = found.attribute("POSITION")
    assert np.abs(positions).max() < 52
    np.testing.assert_array_equal(positions + found.matrix[:3, 3], splats.means)
    accessor = found.document["accessors"][found.primitive["attributes"]["POSITION"]]
    np.testing.assert_array_equal(accessor["min"], positions.min(axis=0))
    np.testing.assert_array_equal(accessor["max"], positions.max(axis=0))
    np.testing.assert_allclose(found.attribute(f"{EXTENSION}:SCALE"), np.exp(splats.scales), rtol=1e-6)
    np.testing.assert_array_equal(found.attribute(f"{EXTENSION}:ROTATION"), splats.quats[:, [1, 2, 3, 0]])
    opacities = 1 / (1 + np.exp(-splats.opacities))
    np.testing.assert_allclose(found.attribute(f"{EXTENSION}:OPACITY")[:, 0], opacities, rtol=1e-5)
    np.testing.assert_array_equal(found.attribute(f"{EXTENSION}:SH_DEGREE_0_COEF_0"), splats.sh0)
    names = [f"SH_DEGREE_{d}_COEF_{n}" for d in range(1, degree + 1) for n in range(2 * d + 1)]
    for k, name in enumerate(names):
        np.testing.assert_array_equal(found.attribute(f"{EXTENSION}:{name}"), splats.shN[:, k])
    assert len(found.primitive["attributes"]) == 6 + REST[degree]
    shades = np.concatenate([splats.sh0 * C0 + 0.5, opacities[:, None]], axis=1).clip(0, 1) * 255
    assert np.abs(found.attribute("COLOR_0") - shades).max() < 0.51


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
    assert {a["count"] for a in found.document["accessors"]} == {500}
    assert not any("bufferView" in a for a in found.document["accessors"])
    assert {f"{EXTENSION}:SH_DEGREE_3_COEF_6", "COLOR_0"} < set(found.primitive["attributes"])


@pytest.mark.parametrize("compression", ["spz", None])
def test_what_does_not_fit_is_refused(
    tmp_path: Path, compression: Compression, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(glb, "_MOST", 1000)
    with pytest.raises(FormatError, match="may have 1000"):
        write_glb(tmp_path / "c", InMemory(scattered(100)), compression)
    assert not list(tmp_path.iterdir())


def issues(path: Path, *plain: str) -> list[dict[str, Any]]:
    """What Khronos' validator says, but that it does not know the extensions."""
    done = node(Path(__file__).with_name("validate.cjs"), peer("gltf-validator").parent, path, *plain)
    assert done.returncode == 0, done.stderr
    found: list[dict[str, Any]] = json.loads(done.stdout)["issues"]["messages"]
    return [issue for issue in found if issue["code"] != "UNSUPPORTED_EXTENSION"]


@pytest.mark.system
@pytest.mark.nightly
@pytest.mark.parametrize("compression", ["spz", None])
def test_khronos_validator(tmp_path: Path, compression: Compression) -> None:
    path = tmp_path / "a.glb"
    write_glb(path, InMemory(far(1000)), compression)
    for issue in issues(path):  # of the extension's semantics, which it does not know
        unused = issue["code"] == "UNUSED_OBJECT" and issue["pointer"] == "/bufferViews/0" and compression
        unknown = issue["code"] == "MESH_PRIMITIVE_INVALID_ATTRIBUTE" and f"/{EXTENSION}:" in issue["pointer"]
        assert unused or unknown, issue
    assert [issue for issue in issues(path, "plain") if issue["code"] != "UNUSED_OBJECT"] == []
    broken = bytearray(path.read_bytes())
    broken[broken.index(b'"min":[-') + 7] = ord(" ")  # the validator looks at the numbers
    path.write_bytes(broken)
    assert compression or any(issue["code"].startswith("ACCESSOR_M") for issue in issues(path, "plain"))
