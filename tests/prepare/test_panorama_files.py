"""Which files of a folder are panoramas."""

import re
from pathlib import Path

import pytest

from panolog.prepare.panorama_files import look_into
from panolog.prepare.video.decode import open_video
from panolog.scene.errors import InputError


def test_links_are_followed_and_what_systems_add_is_left_out(tmp_path: Path) -> None:
    """Half of a capture was missing, or a thumbnail was refused as too small a panorama."""
    folder, elsewhere = tmp_path / "capture", tmp_path / "disk"
    names = (
        "day 2/10.jpg",
        "day 2/9.JPG",
        ".thumbnails/9.jpg",
        "._9.jpg",
        "@eaDir/9.jpg/THUMB_M.jpg",
        "notes.txt",
    )
    for path in (*(folder / name for name in names), elsewhere / "b.png"):
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()
    (folder / "day 1").symlink_to(elsewhere)
    (elsewhere / "above").symlink_to(folder)  # no end
    (folder / ".link").symlink_to(folder / "day 2")
    (folder / ".thumbnails" / "link").symlink_to(elsewhere)
    found = [path.relative_to(folder).as_posix() for path in look_into(folder).images]
    assert found == ["day 1/b.png", "day 2/9.JPG", "day 2/10.jpg"]
    hidden = "._9.jpg, .thumbnails/9.jpg, @eaDir/9.jpg/THUMB_M.jpg"
    assert look_into(folder).left_out == [f"3 files ({hidden}): left out, as hidden files and thumbnails are"]


KINDS = {
    "insp": "a photograph of two fisheye lenses .*; stitch it",
    "insv": "a video of two lenses; stitch it",
    "DNG": "a camera's raw data; develop all alike to TIFF or JPEG",
    "heic": r"HEIC; pip install 'panolog\[formats\]' reads it; or convert it: `heif-convert",
    "jfif": "a JPEG; rename it to NAME.jpg",
    "avif": "AVIF; convert it with `avifdec",
    "jxl": "JPEG XL; convert it with `djxl",
    "zip": "an archive; unpack it",
    "exr": "a picture of high dynamic range; save it tone-mapped",
    "mp4": "a video; give it by itself",
}


@pytest.mark.parametrize("kind", KINDS)
def test_other_kinds_are_counted_and_named(kind: str, tmp_path: Path) -> None:
    """Half of a capture was missing without a word."""
    for number in range(5):
        (tmp_path / f"{number}.{kind}").touch()
    (tmp_path / "notes.txt").touch()
    (line,) = look_into(tmp_path).left_out
    assert re.match(rf"5 files \(0.{kind}, 1.{kind}, 2.{kind}, …\): left out, each {KINDS[kind]}", line)


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("a.heic", "HEIC; pip install"),
        ("a.zip", "an archive; unpack it, and"),
        ("a.jpg", "is one picture; give the folder"),
    ],
)
def test_a_file_that_is_no_video(name: str, words: str, tmp_path: Path) -> None:
    (tmp_path / name).write_bytes(bytes(100))
    with pytest.raises(InputError, match=rf"{name}: .*{words}"), open_video(tmp_path / name):
        pass
