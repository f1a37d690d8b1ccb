"""Scenes in a store are read as those in a folder, with few bytes, and decoded whole."""

import os
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

from panolog.scene.errors import SceneError, StoreError
from panolog.scene.files import here
from panolog.scene.image_files import decode, decode_panorama
from panolog.scene.images import load_view
from panolog.scene.read import read_scene
from panolog.scene.stores.cache import FOLDER, cache_folder
from panolog.scene.stores.stored_scenes import local_folder, remember, stored_of, url_of
from tests.scenes import write_scene

WIDTH = 512  # of panoramas that are larger than their two ends


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(FOLDER, str(tmp_path / "cache"))


def large_scene(root: Path, names: tuple[str, ...] = ()) -> Path:
    """A scene whose panoramas, masks and depth maps are larger than what an outline has of them."""
    write_scene(root, names=names)
    random = np.random.default_rng(0)
    size = (WIDTH // 2, WIDTH)
    for path in (root / "images").iterdir():
        suffix = path.suffix
        data = cv2.imencode(suffix, random.integers(0, 256, (*size, 3), np.uint8))[1]
        path.write_bytes(bytes(data))
        for layer, dtype in (("masks", np.uint8), ("depths", np.uint16)):
            (root / layer).mkdir(exist_ok=True)
            values = random.integers(1, np.iinfo(dtype).max, size, dtype)
            (root / layer / f"{path.stem}.png").write_bytes(bytes(cv2.imencode(".png", values)[1]))
    return root


@pytest.mark.parametrize("names", [(), tuple(f"p{number}.png" for number in range(4))])
def test_a_scene_in_a_store_is_that_of_its_folder(tmp_path: Path, names: tuple[str, ...]) -> None:
    root = large_scene(tmp_path / "place", names)
    (root / "test.txt").write_text(f"{'p1' if names else 'pano_1'}\n")
    (root / "notes").mkdir()
    for name in ("notes/x", ".hidden"):  # neither belongs to a scene
        (root / name).write_text("x")
    url = f"file://{root}"
    plain, stored = read_scene(root), read_scene(url)
    assert stored.fingerprint == plain.fingerprint
    assert (stored.train, stored.test, stored.width) == (plain.train, plain.test, plain.width)
    assert url_of(stored.root) == url
    assert local_folder(url) == stored.root
    assert local_folder(str(root)) == root
    apart = {path.name for path in root.iterdir()} - {path.name for path in stored.root.iterdir()}
    assert apart == {"notes", ".hidden"}
    for row, (ours, theirs) in enumerate(zip(stored.panoramas, plain.panoramas, strict=True)):
        assert [path.relative_to(stored.root) for path in ours.files] == [
            path.relative_to(root) for path in theirs.files
        ]
        assert ours.image.stat().st_blocks * 512 < theirs.image.stat().st_size / 3
        mine, other = load_view(ours, row, WIDTH), load_view(theirs, row, WIDTH)
        assert np.array_equal(mine.image.numpy(), other.image.numpy())
        assert ours.depth and theirs.depth
        assert np.array_equal(decode(ours.depth, -1), decode(theirs.depth, -1))


def test_an_image_that_two_ends_do_not_show_is_read_whole(tmp_path: Path) -> None:
    root = large_scene(tmp_path / "place")
    path = root / "images" / "pano_0.jpg"
    data = path.read_bytes()
    exif = b"\xff\xe1" + (60_000).to_bytes(2, "big") + bytes(59_998)  # the size comes after 16 KiB
    trailer = bytes(100_000)  # the end comes before the last 4 KiB
    path.write_bytes(data[:2] + exif + data[2:] + trailer)
    stored = read_scene(f"file://{root}")
    assert stored.fingerprint == read_scene(root).fingerprint
    assert np.array_equal(decode_panorama(stored.panoramas[0].image), decode_panorama(path))


def test_a_damaged_image_is_named_by_its_url(tmp_path: Path) -> None:
    root = large_scene(tmp_path / "place")
    path = root / "images" / "pano_2.jpg"
    path.write_bytes(path.read_bytes()[:-2_000])
    with pytest.raises(SceneError, match=f"file://{root}/images/pano_2.jpg: the image is truncated"):
        read_scene(f"file://{root}")


def test_a_panorama_that_changes_is_noticed_where_it_is_decoded(tmp_path: Path) -> None:
    root = large_scene(tmp_path / "place")
    scene = read_scene(f"file://{root}")
    os.utime(root / "images" / "pano_0.jpg", (1, 1))
    with pytest.raises(StoreError, match=r"pano_0\.jpg: has changed in the store"):
        decode_panorama(scene.panoramas[0].image)
    assert read_scene(f"file://{root}").root != scene.root  # the run that reads it keeps its own outline


def test_a_scene_without_a_model_is_one_line(tmp_path: Path) -> None:
    (tmp_path / "place").mkdir()
    with pytest.raises(StoreError, match="there is no COLMAP model"):
        read_scene(f"file://{tmp_path}/place")


def test_a_machine_without_the_outline_reads_the_store(tmp_path: Path) -> None:
    root = large_scene(tmp_path / "place")
    scene = read_scene(f"file://{root}")
    image = scene.panoramas[0].image
    stored = stored_of(image)
    assert stored is not None
    shutil.rmtree(cache_folder(os.environ) / "scenes")
    remember(image, stored)
    assert np.array_equal(decode_panorama(here(image)), decode_panorama(root / "images" / "pano_0.jpg"))
