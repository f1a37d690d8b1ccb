import itertools
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import plyfile
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from panolog.scene.errors import InputError
from panolog.scene.gaussians import Gaussians
from panolog.scene.ply import ply_exact, ply_header, read_ply, read_ply_chunks, write_ply, write_ply_parts

STANDARD = (
    ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"]
    + [f"f_rest_{i}" for i in range(45)]
    + ["opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
)


def gaussians(n: int, sky: int = 0, seed: int = 0) -> Gaussians:
    random = torch.Generator().manual_seed(seed)
    shapes = {"means": (3,), "quats": (4,), "scales": (3,), "opacities": (), "sh0": (1, 3), "shN": (15, 3)}
    tensors = {name: torch.randn(n, *shape, generator=random) for name, shape in shapes.items()}
    return Gaussians(**tensors, sky=sky, exact=False)


def split_at(whole: Gaussians, cuts: list[int]) -> list[Gaussians]:
    rows = torch.arange(len(whole))
    edges = [0, *sorted(cuts), len(whole)]
    return [whole.select((rows >= a) & (rows < b)) for a, b in itertools.pairwise(edges)]


def assert_same(a: Gaussians, b: Gaussians) -> None:
    assert a.sky == b.sky
    for name, tensor in a.tensors().items():
        torch.testing.assert_close(b.tensors()[name], tensor, rtol=0, atol=0, msg=name)


@settings(max_examples=25)
@given(data=st.data(), n=st.integers(0, 40), seed=st.integers(0, 1000))
def test_any_parts_read_back_to_the_bit(data: st.DataObject, n: int, seed: int) -> None:
    sky = data.draw(st.integers(0, n))
    cuts = data.draw(st.lists(st.integers(0, n), max_size=4))
    rows = data.draw(st.integers(1, n + 2))
    whole = gaussians(n, sky, seed)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "model.ply"
        write_ply_parts(path, split_at(whole, cuts), count=n, sky=sky)
        assert_same(whole, read_ply(path))
        assert ply_header(path) == (n, sky)
        chunks = list(read_ply_chunks(path, rows))
        assert sum(chunk.sky for chunk in chunks) == sky
        for name, tensor in whole.tensors().items():
            if chunks:
                assert torch.equal(torch.cat([chunk.tensors()[name] for chunk in chunks]), tensor)
        vertex = plyfile.PlyData.read(path)["vertex"]
        assert [p.name for p in vertex.properties] == STANDARD
        assert {p.val_dtype for p in vertex.properties} == {"f4"}
        if n:
            shN = np.stack([vertex[f"f_rest_{i}"] for i in range(45)], axis=1).reshape(n, 3, 15)
            assert np.array_equal(shN.transpose(0, 2, 1), whole.shN.numpy())
            assert np.array_equal(vertex["rot_3"], whole.quats[:, 3].numpy())
            assert not vertex["ny"].any()


@pytest.mark.parametrize("exact", [False, True])
def test_how_a_model_is_seen_is_in_its_header(tmp_path: Path, exact: bool) -> None:
    path = tmp_path / "model.ply"
    write_ply(path, replace(gaussians(5, 2), exact=exact))
    assert (b"comment panolog projection exact\n" in path.read_bytes()) == exact
    assert ply_exact(path) == exact
    assert read_ply(path).exact == exact
    assert all(chunk.exact == exact for chunk in read_ply_chunks(path, 2))


@pytest.mark.parametrize(
    ("cuts", "count", "sky"), [([5], 9, 3), ([5], 11, 3), ([5], 10, 2), ([5], 10, 4), ([], 20, 3)]
)
def test_parts_that_are_not_as_announced_leave_no_file(
    tmp_path: Path, cuts: list[int], count: int, sky: int
) -> None:
    """In the last case there is sky in the middle."""
    parts = split_at(gaussians(10, 3), cuts) * (1 if cuts else 2)
    with pytest.raises(ValueError, match=r"sky is not the last|were announced"):
        write_ply_parts(tmp_path / "model.ply", parts, count=count, sky=sky)
    assert not list(tmp_path.iterdir())


def test_every_truncation_is_noticed(tmp_path: Path) -> None:
    path = tmp_path / "model.ply"
    write_ply(path, gaussians(3))
    data = path.read_bytes()
    for length in (0, 2, 100, 1000, len(data) - 700, len(data) - 248, len(data) - 1):
        path.write_bytes(data[:length])
        with pytest.raises(InputError) as error:
            read_ply(path)
        assert "\n" not in str(error.value)


@pytest.mark.parametrize("degree", [0, 1, 2])
def test_other_trainers_files_are_read_by_column_name(tmp_path: Path, degree: int) -> None:
    rest = (degree + 1) ** 2 - 1
    whole = gaussians(5)
    columns = {"opacity": whole.opacities, **{f"rot_{i}": whole.quats[:, i] for i in range(4)}}
    columns |= {f"f_rest_{c * rest + i}": whole.shN[:, i, c] for c in range(3) for i in range(rest)}
    columns |= {f"f_dc_{i}": whole.sh0[:, 0, i] for i in range(3)}
    columns |= {f"scale_{i}": whole.scales[:, i] for i in range(3)}
    columns |= dict(zip("zyx", whole.means.flip(1).T, strict=True))
    rows = np.empty(5, [(name, "f8" if name in "xyz" else "f4") for name in columns])
    for name, values in columns.items():
        rows[name] = values.numpy()
    path = tmp_path / "other.ply"
    plyfile.PlyData([plyfile.PlyElement.describe(rows, "vertex")], byte_order=">").write(path)
    read = read_ply(path)
    assert torch.equal(read.means, whole.means)
    assert torch.equal(read.shN[:, :rest], whole.shN[:, :rest])
    assert not read.shN[:, rest:].any()
    assert read.sky == 0


@pytest.mark.parametrize(
    "header, complaint",
    [
        ("solid cube", "not a PLY"),
        ("ply\nformat ascii 1.0\nelement vertex 0\nproperty float x\nend_header", "ascii"),
        ("ply\nformat binary_little_endian 1.0\nelement chunk 0\nend_header", "not `vertex`"),
        ("ply\nformat binary_little_endian 1.0\nelement vertex 0\nproperty float x\nend_header", "column y"),
        (
            "ply\nformat binary_little_endian 1.0\nelement vertex 0\nproperty list uchar int i\nend_header",
            "not a number",
        ),
        (
            "ply\nformat binary_little_endian 1.0\nelement vertex 0\nproperty float f_rest_0\nend_header",
            "no SH degree",
        ),
    ],
)
def test_what_is_no_ply_of_gaussians_is_refused(tmp_path: Path, header: str, complaint: str) -> None:
    path = tmp_path / "bad.ply"
    with pytest.raises(InputError, match="no such file"):
        read_ply(path)
    path.write_text(header + "\n")
    with pytest.raises(InputError, match=complaint):
        read_ply(path)
