from collections.abc import Callable
from io import BytesIO
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from panolog.scene import image_files
from panolog.scene.errors import ImageError, InputError
from panolog.scene.image_files import check_images, decode, decode_panorama, decode_with_alpha, read_info
from panolog.scene.pictures.headers import ImageInfo, read_header

PIXELS = np.random.default_rng(0).integers(0, 256, (32, 64, 3), np.uint8)


def test_size_and_depth_come_from_the_header(tmp_path: Path) -> None:
    for name, pixels, info in (
        ("a.jpg", PIXELS, ImageInfo(64, 32, 8, 3)),
        ("a.png", np.zeros((16, 32), np.uint16), ImageInfo(32, 16, 16, 1)),
    ):
        cv2.imwrite(str(tmp_path / name), pixels)
        assert read_info(tmp_path / name) == info


HEADERS: dict[str, Callable[[Path], object]] = {
    "grey.tif": lambda it: cv2.imwrite(str(it), PIXELS[..., 0]),
    "rgb16.tif": lambda it: cv2.imwrite(str(it), PIXELS.astype(np.uint16) * 257),
    "rgba.tif": lambda it: Image.fromarray(np.dstack([PIXELS, PIXELS[..., 0]])).save(it),
    "raw.tif": lambda it: Image.fromarray(PIXELS).save(it, compression=None),
    "jpeg.tif": lambda it: Image.fromarray(PIXELS).save(it, compression="jpeg"),
    "strips.tif": lambda it: Image.fromarray(PIXELS).save(it, compression="tiff_lzw", tiffinfo={278: 8}),
    "lossy.webp": lambda it: Image.fromarray(PIXELS).save(it, quality=80),
    "lossless.webp": lambda it: Image.fromarray(PIXELS).save(it, lossless=True),
    "exif.webp": lambda it: Image.fromarray(PIXELS).save(it, exif=b"Exif\0\0II*\0\b\0\0\0\0\0"),
    "rgba.webp": lambda it: Image.fromarray(np.dstack([PIXELS, PIXELS[..., 0]])).save(it, lossless=True),
    "rgba_lossy.webp": lambda it: Image.fromarray(np.dstack([PIXELS, PIXELS[..., 0]])).save(it),
}


@pytest.mark.parametrize("name", HEADERS)
def test_headers_of_tiff_and_webp_say_what_decoding_does(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / name
    HEADERS[name](path)
    with monkeypatch.context() as patched:
        patched.setattr(image_files, "read_header", lambda _: None)
        decoded = read_info(path)
    monkeypatch.setattr(image_files, "decode", None)
    assert read_info(path) == decoded


@pytest.mark.filterwarnings("ignore::UserWarning")  # Pillow's, of truncated directories
@pytest.mark.parametrize("name", HEADERS)
def test_no_header_is_believed_of_a_truncated_file(name: str, tmp_path: Path) -> None:
    path = tmp_path / name
    HEADERS[name](path)
    data = path.read_bytes()
    whole = read_header(BytesIO(data))
    for length in range(0, len(data) - 1, 61):
        found = read_header(BytesIO(data[:length]))
        assert found is None or (found == whole and length > 0.9 * len(data))  # all but a tag at the end


@pytest.mark.parametrize("suffix, progressive", [("jpg", 0), ("jpg", 1), ("png", 0)])
def test_any_truncation_is_noticed(tmp_path: Path, suffix: str, progressive: int) -> None:
    """Markers, segments and chunks are cut, and what is between them, by a step that meets all of them."""
    path = tmp_path / f"a.{suffix}"
    cv2.imwrite(str(path), PIXELS, [cv2.IMWRITE_JPEG_PROGRESSIVE, progressive])
    data = path.read_bytes()
    for length in {*range(0, 64), *range(0, len(data), 61), *range(len(data) - 40, len(data) - 1)}:
        path.write_bytes(data[:length])
        with pytest.raises(InputError, match=rf"a\.{suffix}"):
            read_info(path)
        with pytest.raises(ImageError, match=r"truncated|cannot be decoded"):
            decode_panorama(path)


@pytest.mark.parametrize("quick", [False, True])
@pytest.mark.parametrize("restarts", [0, 4])
def test_a_jpeg_that_was_cut_and_closed_again_is_truncated(
    tmp_path: Path, restarts: int, quick: bool
) -> None:
    """The missing part of a JPEG is decoded as grey, but a whole picture may be grey, too."""
    path, large = tmp_path / "a.jpg", cv2.resize(PIXELS, (256, 128))
    for pixels in (large, np.full_like(large, 128)):
        cv2.imwrite(str(path), pixels, [cv2.IMWRITE_JPEG_RST_INTERVAL, restarts])
        assert decode_with_alpha(path, 16, quick=quick)[0].shape == (8, 16, 3)
    cv2.imwrite(str(path), large, [cv2.IMWRITE_JPEG_RST_INTERVAL, restarts])
    data = path.read_bytes()
    for length in (len(data) // 2, len(data) - 300):
        path.write_bytes(data[:length] + b"\xff\xd9")
        with pytest.raises(ImageError, match="truncated"):
            decode_with_alpha(path, 16, quick=quick)


@pytest.mark.parametrize("quality", [80, 100])
def test_a_progressive_jpeg_that_lacks_scans_is_truncated(tmp_path: Path, quality: int) -> None:
    """OpenCV decodes such a file, blurred; also where only the last bits of the last scan are missing."""
    path, large = tmp_path / "a.jpg", cv2.resize(PIXELS, (256, 128))
    form = [cv2.IMWRITE_JPEG_PROGRESSIVE, 1, cv2.IMWRITE_JPEG_QUALITY, quality]
    for pixels in (large, np.full_like(large, 128), large[..., 0]):
        cv2.imwrite(str(path), pixels, form)
        assert decode_panorama(path).shape == (128, 256, 3)
    Image.fromarray(large).save(path, progressive=True, quality=quality, subsampling=0)  # of another program
    assert decode_with_alpha(path, 16, quick=True)[0].shape == (8, 16, 3)
    data = path.read_bytes()
    for length in (len(data) // 4, len(data) // 2, len(data) - 200):
        path.write_bytes(data[:length] + b"\xff\xd9")
        with pytest.raises(ImageError, match="truncated"):
            decode_panorama(path)


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


@pytest.mark.parametrize("suffix", ["png", "tiff", "webp", "bmp"])
@pytest.mark.parametrize("reduction", [2, 4, 8])
def test_a_reduction_averages_all_pixels_of_every_format(tmp_path: Path, suffix: str, reduction: int) -> None:
    """Of noise with the deviation 40, n x n pixels leave 40 / n; a subsample would leave more."""
    noise = np.random.default_rng(1).normal(128, 40, (256, 512)).clip(0, 255)
    path = tmp_path / f"a.{suffix}"
    cv2.imwrite(
        str(path), np.repeat(noise[..., None], 3, axis=2).astype(np.uint8), [cv2.IMWRITE_WEBP_QUALITY, 101]
    )
    found, _ = decode_with_alpha(path, 512 // reduction, quick=True)
    assert found.shape == (256 // reduction, 512 // reduction, 3)
    assert found.std() == pytest.approx(40 / reduction, rel=0.1)


def test_a_jpeg_is_reduced_while_it_is_decoded(tmp_path: Path) -> None:
    path = tmp_path / "a.jpg"
    cv2.imwrite(str(path), np.random.default_rng(1).integers(0, 256, (256, 512, 3), np.uint8))
    found, _ = decode_with_alpha(path, 32, quick=True)
    wanted = cv2.imread(str(path), cv2.IMREAD_REDUCED_COLOR_8)
    assert wanted is not None
    assert (found == cv2.resize(wanted, (32, 16), interpolation=cv2.INTER_AREA)[..., ::-1]).all()


@pytest.mark.parametrize("kind", [np.float32, np.int32])
def test_32_bits_are_refused_by_name(kind: type, tmp_path: Path) -> None:
    path = tmp_path / "a.tif"
    cv2.imwrite(str(path), PIXELS.astype(kind))
    with pytest.raises(InputError, match=r"a\.tif: 32 bits a channel; save it with 8 or 16 bits"):
        check_images([path])
    if kind is np.float32:
        with pytest.raises(InputError, match=r"a\.tif: 32 bits a channel; save it with 8 or 16 bits"):
            decode(path, cv2.IMREAD_REDUCED_GRAYSCALE_8)


@pytest.mark.parametrize(
    ("data", "kind"),
    [
        (b"\0\0\0\x18ftypheic\0\0\0\0mif1heic", "HEIC"),
        (b"\0\0\0\x1cftypavif\0\0\0\0", "AVIF"),
        (b"\0\0\0\x0cJXL \r\n\x87\n", "JPEG XL"),
        (b"PK\3\4\x14\0\0\0", "an archive"),
    ],
)
def test_other_formats_are_named_whatever_the_file_is_called(data: bytes, kind: str, tmp_path: Path) -> None:
    (tmp_path / "a.jpg").write_bytes(data + bytes(200))
    with pytest.raises(ImageError, match=rf"a\.jpg: cannot be decoded; it is {kind}, whatever its name says"):
        check_images([tmp_path / "a.jpg"])
