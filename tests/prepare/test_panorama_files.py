"""Which files of a folder are panoramas."""

from pathlib import Path

from panolog.prepare.panorama_files import find_image_files


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
    found = [path.relative_to(folder).as_posix() for path in find_image_files(folder)]
    assert found == ["day 1/b.png", "day 2/9.JPG", "day 2/10.jpg"]
