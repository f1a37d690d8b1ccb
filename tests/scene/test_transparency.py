"""What is transparent in a panorama is ignored, in every format that has transparency, and never bleeds."""

import struct
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from PIL import Image

from panolog.scene.errors import InputError
from panolog.scene.image_files import decode_panorama, decode_used, decode_with_alpha, read_info
from panolog.scene.images import PanoramaCache, load_layers, view_bytes
from panolog.scene.read import read_scene
from panolog.scene.write import NewScene, PosedImage
from panolog.scene.write import write_scene as write_new_scene
from tests.scenes import HEIGHT, WIDTH, write_scene

COLOR = (200, 120, 40)
FORMATS = (
    "rgba.png",
    "rgba16.png",
    "grey.png",
    "palette.png",
    "key.png",
    "rgba.tif",
    "rgba16.tif",
    "rgba.webp",
)


def opacity() -> NDArray[np.uint8]:
    """Transparent in the last quarter of the rows and in one pixel."""
    alpha = np.full((HEIGHT, WIDTH), 255, np.uint8)
    alpha[-HEIGHT // 4 :] = 0
    alpha[5, 7] = 0
    return alpha


def write(path: Path, alpha: NDArray[np.uint8], color: tuple[int, int, int] = COLOR) -> Path:
    """One colour, black where it is transparent, as stitchers write it."""
    path.parent.mkdir(parents=True, exist_ok=True)
    rgb = np.where(alpha[..., None] > 0, np.array(color, np.uint8), np.uint8(0))
    if path.name.startswith("grey"):
        Image.fromarray(np.dstack([rgb[..., 0], alpha]), "LA").save(path)
    elif path.name.startswith("palette"):
        picture = Image.fromarray(np.where(alpha > 0, 1, 0).astype(np.uint8), "P")
        picture.putpalette([0, 0, 0, *color])
        picture.save(path, transparency=0)
    elif path.name.startswith("key"):
        Image.fromarray(rgb).save(path, transparency=(0, 0, 0))
    else:
        save(path, np.dstack([rgb, alpha]))
    return path


def save(path: Path, rgba: NDArray[np.uint8]) -> None:
    """A picture (H, W, 4) as it is, in the format that its name says."""
    if "16" in path.name:
        cv2.imwrite(str(path), cv2.cvtColor(rgba, cv2.COLOR_RGBA2BGRA).astype(np.uint16) * 257)
    else:
        Image.fromarray(rgba).save(path, None, **dict.fromkeys(["lossless", "exact"], path.suffix == ".webp"))


def color_of(name: str) -> tuple[int, int, int]:
    return (COLOR[0],) * 3 if name.startswith("grey") else COLOR


@pytest.mark.parametrize("name", FORMATS)
def test_transparent_pixels_are_a_mask_in_every_format(tmp_path: Path, name: str) -> None:
    path = write(tmp_path / name, opacity())
    assert read_info(path).alpha
    pixels, used = decode_with_alpha(path)
    assert used is not None
    np.testing.assert_array_equal(used, opacity() > 0)
    assert (pixels[used] == color_of(name)).all()
    np.testing.assert_array_equal(decode_used(path), used)
    np.testing.assert_array_equal(decode_panorama(path), pixels)


@pytest.mark.parametrize("name", FORMATS)
@pytest.mark.parametrize("width", [WIDTH // 2, 24])
def test_a_resized_panorama_has_no_black_in_its_colours(tmp_path: Path, name: str, width: int) -> None:
    pixels, used = decode_with_alpha(write(tmp_path / name, opacity()), width)
    assert used is not None and used.shape == (width // 2, width)
    assert not used[-width // 8 :].any()
    mixed = round(5.5 * width / WIDTH - 0.5), round(7.5 * width / WIDTH - 0.5)
    assert not used[mixed]  # as masks are resized: what mixes in an ignored pixel is ignored
    assert (pixels[: width // 2 - width // 8] == color_of(name)).all()  # also the pixel that mixes


@pytest.mark.parametrize("name", ["rgba.png", "rgba16.png", "rgba.tif", "rgba.webp"])
def test_what_is_partly_transparent_counts_by_its_opacity(tmp_path: Path, name: str) -> None:
    rgba = np.zeros((HEIGHT, WIDTH, 4), np.uint8)
    rgba[:, ::2], rgba[:, 1::2] = (250, 0, 100, 51), (50, 200, 100, 255)
    path = tmp_path / name
    save(path, rgba)
    whole, used = decode_with_alpha(path)
    assert used is None  # nothing is fully transparent
    np.testing.assert_allclose(whole[:, :2], np.broadcast_to(rgba[:, :2, :3], (HEIGHT, 2, 3)), atol=3)
    half, used = decode_with_alpha(path, WIDTH // 2)
    assert used is None
    wanted = (np.array([250, 0, 100]) * 51 + np.array([50, 200, 100]) * 255) / 306
    np.testing.assert_allclose(half.reshape(-1, 3), np.broadcast_to(wanted, (half.size // 3, 3)), atol=1)


@pytest.mark.parametrize("width", [WIDTH, WIDTH // 2])
def test_an_opaque_alpha_channel_changes_nothing(tmp_path: Path, width: int) -> None:
    rgb = np.random.default_rng(3).integers(0, 256, (HEIGHT, WIDTH, 3), np.uint8)
    Image.fromarray(rgb).save(tmp_path / "rgb.png")
    Image.fromarray(np.dstack([rgb, np.full(rgb.shape[:2], 255, np.uint8)])).save(tmp_path / "rgba.png")
    (plain, nothing), (pixels, used) = (
        decode_with_alpha(tmp_path / name, width) for name in ("rgb.png", "rgba.png")
    )
    assert nothing is None and used is None
    np.testing.assert_array_equal(pixels, plain)


def test_views_combine_transparency_with_masks(tmp_path: Path) -> None:
    root = write_scene(tmp_path / "scene", names=["a.png", "b.png", "c.png", "d.jpg"])
    write(root / "images" / "a.png", opacity())
    write(root / "images" / "b.png", opacity())
    mask = np.full((HEIGHT, WIDTH), 255, np.uint8)
    mask[:, :8] = 0
    (root / "masks").mkdir()
    cv2.imwrite(str(root / "masks" / "a.png"), mask)
    scene = read_scene(root)
    assert [it.transparent for it in scene.panoramas] == [True, True, False, False]
    assert [view_bytes(it, WIDTH) // (WIDTH * HEIGHT) for it in scene.panoramas] == [4, 4, 3, 3]
    with PanoramaCache(scene, range(4), WIDTH, 10**6) as cache:
        views = [cache.get(row) for row in range(4)]
    transparent = torch.from_numpy(opacity() > 0)
    assert views[0].mask is not None and views[1].mask is not None
    assert torch.equal(views[0].mask, transparent & torch.from_numpy(mask > 0))
    assert torch.equal(views[1].mask, transparent)
    assert views[2].mask is None and views[3].mask is None
    for row in range(4):
        layers, whole = load_layers(scene.panoramas[row], row, WIDTH), views[row].mask
        assert (layers.mask is None) == (whole is None)
        assert layers.mask is None or (whole is not None and torch.equal(layers.mask, whole))


def test_points_get_no_colour_from_what_is_transparent(tmp_path: Path) -> None:
    file, seen = write(tmp_path / "rgba.png", opacity()), np.array([[0.5, 0.25], [0.5, 0.95]])
    images = [
        PosedImage(f"{row}.png", file, np.eye(3), np.array([row, 0.0, 0.0]), (np.arange(2), seen))
        for row in range(3)
    ]
    new = NewScene(images, (WIDTH, HEIGHT), np.arange(12.0).reshape(4, 3), colors=None)
    write_new_scene(tmp_path / "scene", new, link=False)
    assert read_scene(tmp_path / "scene").colors[:2].tolist() == [list(COLOR), [128, 128, 128]]


def chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def test_hostile_files_are_one_clear_error_or_opaque(tmp_path: Path) -> None:
    """A chunk that says that it is longer than any file, and more chunks than any program writes."""
    path, rgb = tmp_path / "rgba.png", write(tmp_path / "key.png", opacity()).read_bytes()
    path.write_bytes(rgb[:33] + struct.pack(">I", 2**32 - 1) + b"tEXt" + rgb[33:])
    with pytest.raises(InputError, match=r"rgba\.png: "):
        decode_with_alpha(path)
    path.write_bytes(rgb[:33] + chunk(b"teSt", b"") * 5_000 + rgb[33:])
    pixels, used = decode_with_alpha(path)
    assert used is None and pixels.shape == (HEIGHT, WIDTH, 3)
