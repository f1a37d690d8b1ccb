import errno
import os
from collections.abc import Callable
from contextlib import AbstractContextManager
from pathlib import Path

import pytest

from panolog.scene.files import SUFFIX, atomic, atomic_folder, natural_key, remove_partial, write_bytes


def test_a_file_appears_whole(tmp_path: Path) -> None:
    path = tmp_path / "a.bin"
    with atomic(path) as temporary:
        temporary.write_bytes(b"new")
        assert not path.exists()
    assert path.read_bytes() == b"new"
    assert list(tmp_path.iterdir()) == [path]


def test_a_failed_write_leaves_the_old_file(tmp_path: Path) -> None:
    path = tmp_path / "a.bin"
    write_bytes(path, b"old")
    with pytest.raises(ZeroDivisionError), atomic(path) as temporary:
        temporary.write_bytes(b"half")
        raise ZeroDivisionError
    assert path.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [path]


def test_a_folder_appears_once_its_files_are_on_the_disk(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    flushed, folder = list[str](), tmp_path / "a"

    def noted(path: Path) -> None:
        flushed.append("" if folder.exists() else path.name)

    monkeypatch.setattr("panolog.scene.files.flush", noted)
    with atomic_folder(folder) as new:
        (new / "part").mkdir()
        (new / "part" / "file").touch()
    assert sorted(flushed) == ["", *sorted([new.name, "part", "file"])]  # at last the folder that names it


@pytest.mark.parametrize("writer", [atomic, atomic_folder])
def test_an_error_names_what_is_written(
    tmp_path: Path, writer: Callable[[Path], AbstractContextManager[Path]]
) -> None:
    with pytest.raises(OSError, match="full") as caught, writer(tmp_path / "a"):
        raise OSError(errno.ENOSPC, "full")
    assert caught.value.filename == str(tmp_path / "a")
    with pytest.raises(OSError, match="No such file") as caught, writer(tmp_path / "none" / "a") as temporary:
        temporary.write_bytes(b"")
    assert caught.value.filename == str(tmp_path / "none" / "a")


def test_a_pipe_gets_the_bytes_and_stays_a_pipe(tmp_path: Path) -> None:
    """So a root's `-o /dev/null` does not replace the device."""
    path = tmp_path / "pipe"
    os.mkfifo(path)
    reader = os.open(path, os.O_RDONLY | os.O_NONBLOCK)
    try:
        write_bytes(path, b"new")
        assert os.read(reader, 10) == b"new"
    finally:
        os.close(reader)
    assert path.is_fifo() and list(tmp_path.iterdir()) == [path]


def test_what_a_killed_writer_left_is_removed(tmp_path: Path) -> None:
    (tmp_path / "blocks").mkdir()
    leftover = tmp_path / "blocks" / f".model.ply.0badcafe{SUFFIX}"
    leftover.write_bytes(b"half")
    write_bytes(tmp_path / "blocks" / "model.ply", b"whole")
    remove_partial(tmp_path)
    assert [path.name for path in (tmp_path / "blocks").iterdir()] == ["model.ply"]


def test_numbers_in_names_sort_by_value() -> None:
    wanted = [
        "a.jpg",
        "a1.jpg",
        "a02.jpg",
        "a2.jpg",
        "a2_9.jpg",
        "a2_10.jpg",
        "a10.jpg",
        "b/9.jpg",
        "b/10.jpg",
    ]
    assert sorted(set(wanted), key=natural_key) == wanted
    assert natural_key("x" + "9" * 5000) > natural_key("x10")  # in no time


def test_names_with_leading_zeros_sort_as_text() -> None:
    names = [f"{stem}{number:06d}{end}" for end in ("-2", "") for number in (99_999, 10, 9) for stem in "aR"]
    assert sorted(names, key=natural_key) == sorted(names)
