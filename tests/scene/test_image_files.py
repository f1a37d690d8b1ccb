from pathlib import Path

import cv2
import numpy as np
import pytest

from panolog.scene.errors import InputError
from panolog.scene.image_files import ImageInfo, read_info
from tests.data import shared

PIXELS = np.random.default_rng(0).integers(0, 256, (32, 64, 3), np.uint8)


@pytest.mark.parametrize("suffix", ["jpg", "png", "webp", "tiff"])
def test_size_and_depth_come_from_the_header(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"a.{suffix}"
    cv2.imwrite(str(path), PIXELS)
    assert read_info(path) == ImageInfo(64, 32, 8, 3)


def test_sixteen_bits_and_one_channel(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "a.png"), np.zeros((16, 32), np.uint16))
    assert read_info(tmp_path / "a.png") == ImageInfo(32, 16, 16, 1)


@pytest.mark.parametrize("progressive", [0, 1])
def test_any_truncated_jpeg_is_noticed(tmp_path: Path, progressive: int) -> None:
    path = tmp_path / "a.jpg"
    cv2.imwrite(str(path), PIXELS, [cv2.IMWRITE_JPEG_PROGRESSIVE, progressive])
    data = path.read_bytes()
    for length in range(0, len(data) - 1):
        path.write_bytes(data[:length])
        with pytest.raises(InputError, match=r"a\.jpg"):
            read_info(path)


def test_any_truncated_png_is_noticed(tmp_path: Path) -> None:
    path = tmp_path / "a.png"
    cv2.imwrite(str(path), PIXELS)
    data = path.read_bytes()
    for length in (*range(0, 64), *range(len(data) - 64, len(data))):
        path.write_bytes(data[:length])
        with pytest.raises(InputError, match=r"a\.png"):
            read_info(path)


def test_what_a_camera_appends_does_not_matter(tmp_path: Path) -> None:
    path = tmp_path / "a.jpg"
    cv2.imwrite(str(path), PIXELS)
    path.write_bytes(path.read_bytes() + b"\0" * 100_000)
    assert read_info(path).width == 64


def test_the_end_of_a_thumbnail_is_not_the_end_of_the_image(tmp_path: Path) -> None:
    path = tmp_path / "a.jpg"
    cv2.imwrite(str(path), PIXELS)
    data = path.read_bytes()
    exif = b"Exif\0\0" + data  # a whole JPEG inside the first segment
    whole = data[:2] + b"\xff\xe1" + (len(exif) + 2).to_bytes(2, "big") + exif + data[2:]
    path.write_bytes(whole)
    assert read_info(path).width == 64
    path.write_bytes(whole[:-200])
    with pytest.raises(InputError, match="truncated"):
        read_info(path)


def test_photographs_of_a_real_camera() -> None:
    for path in (shared("flat") / "images").iterdir():
        assert read_info(path) == ImageInfo(2048, 1024, 8, 3)


def test_what_is_no_image_is_refused(tmp_path: Path) -> None:
    for content in (b"", b"hello, this is text"):
        (tmp_path / "a.jpg").write_bytes(content)
        with pytest.raises(InputError):
            read_info(tmp_path / "a.jpg")
