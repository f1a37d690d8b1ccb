"""SOG: what is written is read again, within the steps of its numbers, and with the same bytes each time."""

import json
import zipfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from panolog.export.order import morton_order
from panolog.export.sog.read import read_sog
from panolog.export.sog.write import encode, write_sog
from panolog.export.splats import REST, InMemory, Splats
from tests.export.sog.models import source, splats, turned_alike, write_unpacked


def assert_alike(found: Splats, wanted: Splats, palette_error: float = 0.03) -> None:
    """Each value is within its step: half of one where there are steps."""
    assert len(found) == len(wanted) and found.degree == wanted.degree
    span = np.ptp(np.sign(wanted.means) * np.log1p(np.abs(wanted.means)), axis=0)
    steps = (span / 65_535 / 2) * (1 + np.abs(wanted.means)) * 1.01 + 1e-6
    assert (np.abs(found.means - wanted.means) <= steps).all()
    # Three components are within half a step; the fourth follows from them.
    assert np.abs(turned_alike(found.quats, wanted.quats) - wanted.quats).max() < 0.01
    alpha = [1 / (1 + np.exp(-each.opacities)) for each in (found, wanted)]
    assert np.abs(alpha[0] - alpha[1]).max() < 0.5 / 255 + 1e-5
    for name in ("scales", "sh0"):
        difference = np.abs(getattr(found, name) - getattr(wanted, name))
        assert np.sqrt(np.square(difference).mean()) < 0.01 * np.ptp(getattr(wanted, name))
    if found.degree:
        assert np.sqrt(np.square(found.shN - wanted.shN).mean()) < palette_error


@pytest.mark.parametrize(
    ("count", "degree"),
    [*((3000, degree) for degree in range(4)), (1, 3), (2, 3), (15, 3), (16, 3), (17, 3), (64, 3), (65, 3)],
)
def test_it_is_read_again(tmp_path: Path, count: int, degree: int) -> None:
    model = splats(count, degree)
    write_sog(tmp_path / "a.sog", InMemory(model))
    wanted = model.select(morton_order(model.means))
    assert_alike(read_sog(tmp_path / "a.sog"), wanted, 0.03 if count == 3000 else 0.15)


def test_gaussians_in_one_place(tmp_path: Path) -> None:
    one = Splats.joined([splats(1)] * 300)
    write_sog(tmp_path / "one.sog", InMemory(one))
    found = read_sog(tmp_path / "one.sog")
    np.testing.assert_allclose(found.means, one.means, rtol=1e-6)
    np.testing.assert_allclose(found.shN, one.shN, atol=0.01)


def test_numbers_are_where_the_format_has_them(tmp_path: Path) -> None:
    """By hand, from PlayCanvas's description; nothing of the reader is used."""
    write_unpacked(tmp_path, source(700))
    meta, found = json.loads((tmp_path / "meta.json").read_text()), read_sog(tmp_path)

    def pixels(part: str, number: int = 0) -> np.ndarray:
        image = np.asarray(Image.open(tmp_path / meta[part]["files"][number]))
        return image.reshape(-1, image.shape[2])[:700].astype(int)

    low, high = (np.array(meta["means"][name]) for name in ("mins", "maxs"))
    place = low + (high - low) * (pixels("means", 1)[:, :3] * 256 + pixels("means")[:, :3]) / 65_535
    np.testing.assert_allclose(found.means, np.sign(place) * np.expm1(np.abs(place)), rtol=1e-4, atol=1e-5)
    for part in ("scales", "sh0"):
        values = np.array(meta[part]["codebook"])[pixels(part)[:, :3]]
        np.testing.assert_allclose(getattr(found, part), values, rtol=1e-5, atol=1e-6)
    rest, largest = (pixels("quats")[:, :3] / 255 - 0.5) * np.sqrt(2), pixels("quats")[:, 3] - 252
    for row in range(700):  # the largest of w x y z is left out
        expected = np.insert(rest[row], largest[row], np.sqrt(max(0, 1 - np.square(rest[row]).sum())))
        np.testing.assert_allclose(turned_alike(found.quats[[row]], expected[None]), [expected], atol=1e-3)
    labels = pixels("shN", 1)[:, 0] + 256 * pixels("shN", 1)[:, 1]
    palette = np.asarray(Image.open(tmp_path / meta["shN"]["files"][0]))
    entries = palette[labels // 64].reshape(700, 64, 15, -1)[np.arange(700), labels % 64][..., :3]
    np.testing.assert_allclose(found.shN, np.array(meta["shN"]["codebook"])[entries], rtol=1e-5, atol=1e-6)


def test_what_is_transparent_keeps_its_colour(tmp_path: Path) -> None:
    model = splats(400, 0)
    clear = Splats(**model.columns() | {"opacities": np.full(400, -20, np.float32)})
    write_sog(tmp_path / "a.sog", InMemory(clear))
    found = read_sog(tmp_path / "a.sog")
    wanted = model.select(morton_order(model.means)).sh0
    assert np.abs(found.sh0 - wanted).max() < 0.1 and found.opacities.max() < -13


def test_folder_and_file_hold_the_same(tmp_path: Path) -> None:
    write_sog(tmp_path / "a.sog", source(700))
    with zipfile.ZipFile(tmp_path / "a.sog") as archive:
        assert archive.testzip() is None
        archive.extractall(tmp_path / "folder")
        assert {entry.compress_type for entry in archive.infolist()} == {zipfile.ZIP_STORED}
        assert {entry.date_time for entry in archive.infolist()} == {(1980, 1, 1, 0, 0, 0)}
    for path in (tmp_path / "folder", tmp_path / "folder/meta.json"):
        np.testing.assert_array_equal(read_sog(path).means, read_sog(tmp_path / "a.sog").means)


def test_bytes_do_not_depend_on_threads_or_pieces() -> None:
    made = []
    for threads in (1, 4):
        with ThreadPoolExecutor(threads) as pool:
            made.append(encode(source(70_000, 1), pool))
    assert made[0] == made[1]


def test_version_1(tmp_path: Path) -> None:
    """As PlayCanvas's readers decode it: linear between bounds, opacity as logit, bands by the width."""
    rng, size = np.random.default_rng(3), REST[2]
    images = {
        name: rng.integers(0, 256, (5, 4, 4), np.uint8) for name in ("l", "u", "scales", "quats", "sh0")
    }
    images["quats"][..., 3] = 252 + rng.integers(0, 4, (5, 4))
    images["labels"] = np.stack([rng.integers(0, 64, (5, 4), np.uint8), *np.zeros((2, 5, 4), np.uint8)], -1)
    images["centroids"] = rng.integers(0, 256, (1, 64 * size, 3), np.uint8)
    for name, pixels in images.items():
        Image.fromarray(pixels).save(tmp_path / f"{name}.webp", lossless=True, exact=True)
    means = {"shape": [20, 3], "mins": [-1, -2, -3], "maxs": [1, 2, 3], "files": ["l.webp", "u.webp"]}
    meta = {
        "means": means,
        "scales": {"mins": [-9, -8, -7], "maxs": [1, 2, 3], "files": ["scales.webp"]},
        "quats": {"files": ["quats.webp"]},
        "sh0": {"mins": [-1, -2, -3, -4], "maxs": [1, 2, 3, 4], "files": ["sh0.webp"]},
        "shN": {"mins": -0.5, "maxs": 0.25, "files": ["centroids.webp", "labels.webp"]},
    }
    (tmp_path / "meta.json").write_text(json.dumps(meta))
    found = read_sog(tmp_path)
    flat = {name: pixels.reshape(-1, pixels.shape[-1]).astype(float) for name, pixels in images.items()}
    np.testing.assert_allclose(found.scales[:, 1], -8 + 10 * flat["scales"][:, 1] / 255, rtol=1e-5)
    np.testing.assert_allclose(found.opacities, -4 + 8 * flat["sh0"][:, 3] / 255, rtol=1e-4, atol=1e-6)
    place = -2 + 4 * (flat["u"][:, 1] * 256 + flat["l"][:, 1]) / 65_535
    np.testing.assert_allclose(found.means[:, 1], np.sign(place) * np.expm1(abs(place)), rtol=1e-5, atol=1e-6)
    entry = images["centroids"][0].reshape(64, size, 3)[images["labels"][..., 0].ravel()]
    np.testing.assert_allclose(found.shN, -0.5 + 0.75 * entry / 255, rtol=1e-4, atol=1e-6)
