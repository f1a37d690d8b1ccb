import struct
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from panolog.scene.errors import ImageError, InputError
from panolog.scene.image_files import decode_with_alpha
from panolog.scene.images import PanoramaCache, load_view
from panolog.scene.read import read_scene
from tests.scenes import HEIGHT, WIDTH, write_scene

VIEW = 3 * WIDTH * HEIGHT  # bytes of a view without layers


@pytest.fixture
def root(tmp_path: Path) -> Path:
    return write_scene(tmp_path / "scene", names=[f"{i}.png" for i in range(6)])


def draw(path: Path, pixels: NDArray[Any]) -> None:
    path.parent.mkdir(exist_ok=True)
    cv2.imwrite(str(path), pixels)


def pixels_of(path: Path) -> NDArray[Any]:
    """(H, W, 3) RGB."""
    pixels = cv2.imread(str(path))
    assert pixels is not None
    return pixels[..., ::-1]


def test_a_view_is_rgb_and_the_mean_of_its_pixels(root: Path) -> None:
    scene = read_scene(root)
    stored = pixels_of(scene.panoramas[2].image)
    with PanoramaCache(scene, range(6), WIDTH, 10 * VIEW) as cache:
        view = cache.get(2)
    assert (view.row, view.mask, view.sky, view.inverse_depth) == (2, None, None, None)
    assert np.array_equal(view.image.numpy(), stored)
    with PanoramaCache(scene, range(6), WIDTH // 2, 10 * VIEW) as cache:
        small = cache.get(2).image.numpy()
    mean = stored.reshape(HEIGHT // 2, 2, WIDTH // 2, 2, 3).mean(axis=(1, 3))
    assert small.dtype == np.uint8
    assert np.abs(small - mean).max() <= 0.75  # rounding


@pytest.mark.parametrize("budget", [0, 2 * VIEW, 100 * VIEW])
def test_any_order_and_budget_gives_the_same_views(root: Path, budget: int) -> None:
    scene = read_scene(root)
    expected = [pixels_of(p.image) for p in scene.panoramas]
    order = [0, 3, 3, 5, 1, 0, 2, 4, 0, 3]
    with PanoramaCache(scene, range(6), WIDTH, budget) as cache:
        for step, row in enumerate(order):
            cache.prefetch(order[step : step + 4])
            assert np.array_equal(cache.get(row).image.numpy(), expected[row])


def test_what_fits_is_decoded_once_and_what_does_not_is_dropped(root: Path) -> None:
    scene = read_scene(root)
    with PanoramaCache(scene, range(6), WIDTH, 2 * VIEW) as cache:
        cache.prefetch([4, 5, 0])  # only two fit
        first, second = cache.get(4), cache.get(5)
        assert cache.get(4) is first
        cache.get(0)  # drops 5, the least recently wanted
        assert cache.get(4) is first
        assert cache.get(5) is not second


def test_the_budget_counts_bytes_of_views_of_the_width(root: Path) -> None:
    scene = read_scene(root)
    with PanoramaCache(scene, range(6), WIDTH // 2, 2 * VIEW) as cache:
        kept = [cache.get(row) for row in range(6)]
        assert all(cache.get(row) is kept[row] for row in range(6))  # views of a fourth of the bytes


@pytest.mark.parametrize("width", [0, 31, WIDTH + 2])
def test_a_width_that_is_odd_or_too_large_is_refused(root: Path, width: int) -> None:
    with pytest.raises(InputError, match=f"width {width}"):
        PanoramaCache(read_scene(root), range(6), width, 2 * VIEW)


def test_layers_are_resized_without_mixing_in_what_has_no_value(root: Path) -> None:
    mask, sky = np.full((HEIGHT, WIDTH), 255, np.uint8), np.zeros((HEIGHT, WIDTH), np.uint8)
    mask[20, 10] = 0  # a single pixel of the operator
    sky[8:] = 255
    sky[7, :] = 255  # the horizon cuts no new pixel in half: rows 6 and 7 tie, and a tie is sky
    draw(root / "masks" / "0.png", mask)
    draw(root / "skymasks" / "0.png", sky)
    depth = np.zeros((HEIGHT // 4, WIDTH // 4), np.uint16)
    depth[3:] = 40000
    draw(root / "depths" / "0.png", depth)
    with PanoramaCache(read_scene(root), [0], WIDTH // 2, 1) as cache:
        view = cache.get(0)
    assert view.mask is not None and view.sky is not None and view.inverse_depth is not None
    ignored = torch.ones(HEIGHT // 2, WIDTH // 2, dtype=torch.bool)
    ignored[10, 5] = False
    assert torch.equal(view.mask, ignored)
    assert view.sky[:3].all() and not view.sky[4:].any()
    values = np.unique(view.inverse_depth.numpy())
    np.testing.assert_allclose(values, [0, 40000 / 65535], rtol=1e-6)
    assert view.inverse_depth.shape == (HEIGHT // 2, WIDTH // 2)
    assert (view.inverse_depth[:6] == 0).all() and (view.inverse_depth[6:] > 0).all()


def test_a_sky_mask_of_ones_is_one_of_255(root: Path) -> None:
    """All was sky, and the geometry was lost."""
    ground = np.zeros((HEIGHT, WIDTH), np.uint8)
    ground[HEIGHT // 2 :] = 1
    draw(root / "skymasks" / "0.png", ground)
    draw(root / "skymasks" / "1.png", 255 * ground)
    draw(root / "skymasks" / "2.png", 17 * ground)
    scene = read_scene(root)
    ones, whole = (load_view(scene.panoramas[row], row, WIDTH).sky for row in (0, 1))
    assert ones is not None and whole is not None and torch.equal(ones, whole)
    assert ones[0].all() and not ones[-1].any()
    with pytest.raises(ImageError, match=r"2\.png: its largest value is 17, so all of it would be sky"):
        load_view(scene.panoramas[2], 2, WIDTH)


def _mask(kind: str, keep: NDArray[np.bool_]) -> NDArray[Any]:
    """What a program saves for pixels to keep."""
    white = np.where(keep, 255, 0).astype(np.uint8)
    all_white = np.full((*keep.shape, 3), 255, np.uint8)
    return {
        "grey": white,
        "colours": np.dstack([white] * 3),
        "one": keep.astype(np.uint8),
        "classes": np.where(keep, 11, 0).astype(np.uint8),
        "alpha": np.dstack([all_white, white]),  # the mask is in the alpha channel alone
        "both": np.dstack([np.dstack([white] * 3), np.full_like(white, 255)]),
        "red": np.dstack([white * 0, white * 0, white]),
    }[kind]


@pytest.mark.parametrize("kind", ["grey", "colours", "one", "classes", "alpha", "both", "red", "jpeg"])
def test_a_mask_is_what_is_black_or_transparent(kind: str, root: Path) -> None:
    """One whose mask is in the alpha channel masked nothing; the noise of a JPEG was used."""
    keep = np.zeros((HEIGHT, WIDTH), bool)
    keep[: HEIGHT - 13, 11:] = True  # edges within the blocks of a JPEG
    path = root / "masks" / "1.png"
    draw(path, _mask("grey" if kind == "jpeg" else kind, keep))
    if kind == "jpeg":
        path.write_bytes(bytes(cv2.imencode(".jpg", _mask("grey", keep), [cv2.IMWRITE_JPEG_QUALITY, 60])[1]))
    mask = load_view(read_scene(root).panoramas[1], 1, WIDTH).mask
    assert mask is not None
    assert np.array_equal(mask.numpy(), keep)


def test_an_exif_orientation_does_not_turn_a_panorama(tmp_path: Path) -> None:
    scene = read_scene(write_scene(tmp_path / "scene", names=["a.jpg", "b.jpg", "c.jpg"]))
    data = scene.panoramas[0].image.read_bytes()
    quarter_turn = b"II*\0\x08\0\0\0\x01\0\x12\x01\x03\0\x01\0\0\0\x06\0\0\0\0\0\0\0"
    exif = b"Exif\0\0" + quarter_turn
    turned = data[:2] + b"\xff\xe1" + (len(exif) + 2).to_bytes(2, "big") + exif + data[2:]
    with PanoramaCache(scene, [0], WIDTH, 0) as cache:
        before = cache.get(0).image
    scene.panoramas[0].image.write_bytes(turned)
    assert pixels_of(scene.panoramas[0].image).shape == (WIDTH, HEIGHT, 3)  # OpenCV would turn it
    with PanoramaCache(scene, [0], WIDTH, 0) as cache:
        assert torch.equal(cache.get(0).image, before)


@pytest.mark.parametrize(("order", "big"), [("<", False), ("<", True), (">", False)])
@pytest.mark.parametrize("orientation", [1, 3, 6])
def test_nor_does_that_of_a_tiff(order: str, big: bool, orientation: int, tmp_path: Path) -> None:
    """OpenCV turns these whatever its flags say, so a scene of TIFFs was trained upside down."""
    grey = np.random.default_rng(0).integers(256, size=(HEIGHT, WIDTH), dtype=np.uint8)
    number, counts = ("Q", "HQ") if big else ("I", "HI")
    first = 16 if big else 8  # byte of the pixels; the directory is behind them
    tags = {256: WIDTH, 257: HEIGHT, 258: 8, 259: 1, 262: 1, 273: first, 274: orientation, 277: 1}
    tags |= {278: HEIGHT, 279: grey.size}
    head = {"<": b"II", ">": b"MM"}[order]
    head += struct.pack(order + ("3HQ" if big else "HI"), *((43, 8, 0) if big else (42,)), first + grey.size)
    directory = struct.pack(order + ("Q" if big else "H"), len(tags))
    for tag, value in tags.items():
        directory += struct.pack(order + "H" + counts + "H", tag, 3, 1, value) + bytes(6 if big else 2)
    path = tmp_path / "a.tif"
    path.write_bytes(head + grey.tobytes() + directory + struct.pack(order + number, 0))
    assert np.array_equal(decode_with_alpha(path)[0], np.dstack([grey] * 3))


def test_a_damaged_image_is_named_when_it_is_asked_for(root: Path) -> None:
    scene = read_scene(root)
    scene.panoramas[1].image.write_bytes(b"\x89PNG\r\n\x1a\n and no more")
    scene.panoramas[2].image.unlink()
    with PanoramaCache(scene, range(6), WIDTH, 10 * VIEW) as cache:
        cache.prefetch(range(6))
        for row in (1, 2):
            with pytest.raises(InputError, match=rf"{row}\.png"):
                cache.get(row)
        assert cache.get(0).row == 0
        with pytest.raises(KeyError):
            cache.get(17)
