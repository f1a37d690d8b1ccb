"""Which sources a scene is made of: their labels, their order, and what is left out."""

import os
from datetime import datetime, timezone
from pathlib import Path

import av
import numpy as np
import pytest

from panolog.prepare.sources.find import find_sources
from panolog.scene.errors import InputError
from tests.prepare.world.stills import write_still

NOON = 1_700_000_000  # seconds, 2023-11-14 22:13:20 UTC


def file(path: Path, age: int = 0) -> Path:
    """An empty file, written so many seconds before NOON."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.touch()
    os.utime(path, (NOON - age, NOON - age))
    return path


def video(path: Path, begun: datetime, age: int = 0) -> Path:
    """A video whose header says when it begins."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with av.open(str(path), "w", options={"movflags": "use_metadata_tags"}) as container:
        container.metadata["creation_time"] = begun.strftime("%Y-%m-%dT%H:%M:%S.000000Z")
        stream = container.add_stream("mpeg4", rate=30)
        stream.width, stream.height, stream.pix_fmt = 64, 32, "yuv420p"
        frame = av.VideoFrame.from_ndarray(np.zeros((32, 64, 3), np.uint8), format="rgb24")
        for packet in (*stream.encode(frame), *stream.encode()):
            container.mux(packet)
    os.utime(path, (NOON - age, NOON - age))
    return path


def labels(*given: Path) -> list[str]:
    return [source.label for source in find_sources(given).all]


def test_a_sole_source_has_no_label(tmp_path: Path) -> None:
    walk = file(tmp_path / "card" / "walk.mp4")
    for given in (walk, tmp_path / "card"):  # a folder with one video is that video
        (source,) = find_sources([given]).all
        assert (source.path, source.label, source.is_video) == (walk, "", True)
    (source,) = find_sources([file(tmp_path / "photos" / "a.jpg").parent]).all
    assert (source.path, source.label, source.is_video) == (tmp_path / "photos", "", False)


def test_each_source_has_a_label_of_its_own(tmp_path: Path) -> None:
    given = [
        file(tmp_path / "monday" / "walk one.mp4", 9),
        file(tmp_path / "tuesday" / "walk one.mp4", 8),
        file(tmp_path / "garden.mp4", 7),
        file(tmp_path / "garden" / "a.jpg", 6).parent,
        file(tmp_path / "clip.mp4", 5),
        file(tmp_path / "clip.mov", 4),
    ]
    found = labels(*given)
    assert found[:2] == ["monday-walk_one", "tuesday-walk_one"]
    assert len(set(found)) == len(given)
    assert found[2].endswith("garden") and found[4].endswith("clip") and found[5].endswith("clip-2")


def test_sources_are_in_the_order_of_capture(tmp_path: Path) -> None:
    """By the camera's clock, and where it wrote none by the time of the file."""
    late = video(tmp_path / "a.mp4", datetime(2026, 5, 2, 9, tzinfo=timezone.utc), age=900)
    early = video(tmp_path / "b.mp4", datetime(2026, 5, 1, 9, tzinfo=timezone.utc), age=0)
    before = file(tmp_path / "c.mkv", age=10)  # in 2023
    photos = tmp_path / "photos"
    write_still(photos / "a.jpg", np.zeros((32, 64, 3), np.uint8))  # in 2024
    assert labels(late, early, before, photos) == ["c", "photos", "b", "a"]
    assert labels(photos, before, early, late) == ["c", "photos", "b", "a"]


def test_chapters_follow_each_other(tmp_path: Path) -> None:
    names = ("GX020007.MP4", "GX010007.MP4", "GX030007.MP4", "GX010008.MP4", "GX020008.MP4")
    for age, name in enumerate(names):  # of those of one recording, the last may have been written first
        file(tmp_path / name, 100 - age)
    assert labels(tmp_path) == ["GX010007", "GX020007", "GX030007", "GX010008", "GX020008"]
    for name in ("GOPR0009.MP4", "GP010009.MP4", "GP100009.MP4", "GP020009.MP4"):
        file(tmp_path / "old" / name)
    assert labels(tmp_path / "old") == ["GOPR0009", "GP010009", "GP020009", "GP100009"]


def test_files_of_second_lenses_and_previews_are_no_videos_of_their_own(tmp_path: Path) -> None:
    for number in ("001", "002"):
        for lens in ("VID_{}_00_{}", "VID_{}_10_{}", "LRV_{}_11_{}"):
            file(tmp_path / f"{lens.format('20260501_101010', number)}.insv")
    file(tmp_path / "walk_00_a.mp4")
    file(tmp_path / "walk_10_a.mp4")  # no second lens, but a name that looks like one
    found = find_sources([tmp_path])
    assert sorted(source.path.stem for source in found.all) == [
        "VID_20260501_101010_00_001",
        "VID_20260501_101010_00_002",
        "walk_00_a",
        "walk_10_a",
    ]
    (line,) = found.left_out
    assert line.startswith("2 files (LRV_20260501_101010_11_001.insv, ")


def test_what_is_no_video_in_a_folder_of_videos_is_named(tmp_path: Path) -> None:
    file(tmp_path / "a.mp4"), file(tmp_path / "b.mp4"), file(tmp_path / "c.360"), file(tmp_path / "d.jxl")
    found = find_sources([tmp_path])
    assert [source.label for source in found.all] == ["a", "b"]
    assert [line.partition(":")[0] for line in found.left_out] == ["1 file (c.360)", "1 file (d.jxl)"]


def test_a_folder_of_pictures_is_one_source_whatever_videos_are_in_it(tmp_path: Path) -> None:
    for name in ("a.insp", "b.mp4"):
        file(tmp_path / "raw" / name)
    for name in ("images/a.jpg", "b.mp4"):
        file(tmp_path / "place" / name)
    assert labels(tmp_path / "raw", tmp_path / "place") == ["place", "raw"]


@pytest.mark.parametrize("again", ["walk.mp4", "../card/walk.mp4", "link.mp4", "."])
def test_nothing_is_taken_twice(again: str, tmp_path: Path) -> None:
    walk = file(tmp_path / "card" / "walk.mp4")
    if again == "link.mp4":
        (tmp_path / "link.mp4").symlink_to(walk)
        other = tmp_path / "link.mp4"
    else:
        other = tmp_path / "card" / again
    with pytest.raises(InputError, match=r"walk\.mp4: is given twice; give each"):
        find_sources([walk, other])


def test_a_missing_source_is_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"no\.mp4: there is no such folder or video"):
        find_sources([file(tmp_path / "a.mp4"), tmp_path / "no.mp4"])


def test_a_run_is_no_folder_of_panoramas(tmp_path: Path) -> None:
    """The previews in the folder of a run would be taken for panoramas."""
    run = file(tmp_path / "run" / "run.json").parent
    file(run / "coarse" / "previews" / "000001.jpg")
    with pytest.raises(InputError, match=r"run: is the folder of a run; give the scene"):
        find_sources([run])


def test_labels_of_the_scene_that_sources_are_added_to_are_taken(tmp_path: Path) -> None:
    walk, other = file(tmp_path / "monday" / "walk.mp4", 2), file(tmp_path / "garden.mp4", 1)
    found = find_sources([walk, other], {"walk", "scene"})
    assert [source.label for source in found.all] == ["monday-walk", "garden"]
    assert [source.label for source in find_sources([other], {"scene"}).all] == ["garden"]
