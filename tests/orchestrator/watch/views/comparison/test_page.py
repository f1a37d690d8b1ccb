"""A report of several runs: one self-contained page, whatever the runs' files hold."""

import base64
import re
import struct
from pathlib import Path

import cv2
import numpy as np
import pytest

from panolog.orchestrator.runs.folder import RunFolder
from panolog.orchestrator.watch.views.comparison.page import write_comparison
from panolog.scene.errors import InputError
from tests.orchestrator.watch.views.comparison.runs import metrics, write, write_picture
from tests.orchestrator.watch.views.pages.snapshots import self_contained, snapshot_of

JPEG = "data:image/jpeg;base64,"


def page_of(tmp_path: Path, *folders: RunFolder) -> str:
    output = tmp_path / "page.html"
    write_comparison([folder.root for folder in folders], output)
    return output.read_text()


def grey(url: str) -> tuple[int, int, int]:
    """The size of a picture in a data URL, and its mean grey."""
    raw = np.frombuffer(base64.b64decode(url.removeprefix(JPEG)), np.uint8)
    picture = cv2.imdecode(raw, cv2.IMREAD_GRAYSCALE)
    assert picture is not None
    return picture.shape[1], picture.shape[0], round(float(picture.mean()))


def test_it_is_one_page_with_all_of_it(tmp_path: Path) -> None:
    first, second = write(tmp_path / "a", measured=metrics()), write(tmp_path / "b", measured=metrics())
    write_picture(first, "b.jpg", 20, 200)
    write_picture(second, "b.jpg", 100, 200, width=2048)
    page = page_of(tmp_path, first, second)
    assert self_contained(page)
    assert "default-src 'none'" in page
    found = snapshot_of(page)["answers"]
    assert [run["name"] for run in found["compare?"]["runs"]] == ["a", "b"]
    assert [len(run["stages"]) for run in found["compare/curves?"]["runs"]] == [2, 2]
    (view,) = (view for view in found["compare?"]["views"] if view["truth"])
    assert view["name"] == "b.jpg"
    assert grey(view["pictures"][0]) == (64, 32, 20)
    assert grey(view["pictures"][1]) == (1024, 512, 100)
    assert grey(view["truth"]) == (64, 32, 200)


def test_the_same_runs_make_the_same_page(tmp_path: Path) -> None:
    folders = [write(tmp_path / name, measured=metrics()) for name in "ab"]
    for folder in folders:
        write_picture(folder, "a.jpg", 20, 200)
    pages = [re.sub(r"written .* UTC", "", page_of(tmp_path, *folders)) for _ in range(2)]
    assert pages[0] == pages[1]


@pytest.mark.parametrize(("count", "most"), [(2, 12), (8, 6)])
def test_pictures_are_few_and_small(tmp_path: Path, count: int, most: int) -> None:
    values = {f"{number:02d}.jpg": float(number) for number in range(20)}
    folders = [write(tmp_path / str(number), measured=metrics(values)) for number in range(count)]
    for folder in folders:
        for name in values:
            write_picture(folder, name, 20, 200, width=1024)
    page = page_of(tmp_path, *folders)
    shown = [view["name"] for view in snapshot_of(page)["answers"]["compare?"]["views"] if view["truth"]]
    assert (len(shown), shown[0], shown[-1]) == (most, "00.jpg", "19.jpg")
    assert len(page) < 8_000_000


def huge_jpeg(width: int, height: int) -> bytes:
    """A small JPEG whose header states another size."""
    raw = bytes(cv2.imencode(".jpg", np.zeros((8, 8, 3), np.uint8))[1])
    at = raw.index(b"\xff\xc0") + 5
    return raw[:at] + struct.pack(">HH", height, width) + raw[at + 4 :]


def test_pictures_that_are_none_are_left_out(tmp_path: Path) -> None:
    views = dict.fromkeys(("cut", "bomb", "png", "wide", "empty", "link", "good"), 20.0)
    first = write(tmp_path / "a", measured=metrics({f"{name}.jpg": value for name, value in views.items()}))
    write_picture(first, "good.jpg", 20, 200)
    good = first.picture("good.jpg").read_bytes()
    (tmp_path / "outside.jpg").write_bytes(good)
    first.picture("cut.jpg").write_bytes(good[: len(good) // 3])
    first.picture("bomb.jpg").write_bytes(huge_jpeg(65_000, 65_000))
    first.picture("png.jpg").write_bytes(bytes(cv2.imencode(".png", np.zeros((64, 64, 3), np.uint8))[1]))
    first.picture("wide.jpg").write_bytes(bytes(cv2.imencode(".jpg", np.zeros((8, 64, 3), np.uint8))[1]))
    first.picture("empty.jpg").touch()
    first.picture("link.jpg").symlink_to(tmp_path / "outside.jpg")
    found = snapshot_of(page_of(tmp_path, first, write(tmp_path / "b")))["answers"]["compare?"]["views"]
    assert {view["name"] for view in found if any(view["pictures"]) or view["truth"]} == {"good.jpg"}
    assert len(found) == len(views)


def test_a_page_that_cannot_be_made_leaves_the_last_one(tmp_path: Path) -> None:
    first, second = write(tmp_path / "a"), write(tmp_path / "b")
    before = page_of(tmp_path, first, second)
    second.database.write_bytes(b"no database" * 1_000)
    with pytest.raises(InputError, match=r"run\.db"):
        page_of(tmp_path, first, second)
    assert (tmp_path / "page.html").read_text() == before
