"""Files on machines that do not have them, with a real Ray whose one machine plays both parts."""

import os
import shutil
import signal
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import pytest
import ray
import torch

from panolog.orchestrator.engine.cluster import remote_files as node_files
from panolog.orchestrator.engine.cluster.connection import connect
from panolog.orchestrator.engine.cluster.remote_files import (
    FileSharing,
    NodeFiles,
    RayValue,
    Stamp,
    run_remotely,
)
from panolog.orchestrator.runs.machines.usage import Usage
from panolog.scene.errors import RunError
from panolog.scene.stores.cache import Stored
from panolog.scene.stores.store import Version
from panolog.scene.stores.stored_scenes import stored_of
from panolog.workers.events import Checkpoint, Event, Preview
from panolog.workers.tasks import COARSE, Progress, Transfer
from tests.orchestrator.scripted import Scripted
from tests.ray_head import wait_until

pytestmark = pytest.mark.system

CONTENT = bytes(range(256)) * 1000


@pytest.fixture(scope="module")
def sharing(tmp_path_factory: pytest.TempPathFactory) -> Iterator[FileSharing]:
    root = tmp_path_factory.mktemp("run")
    with connect(None, root):
        yield FileSharing(root)


@pytest.fixture(autouse=True)
def _nothing_received() -> None:
    node_files.received_bytes()


@pytest.fixture
def image(tmp_path: Path) -> Path:
    path = tmp_path / "a.jpg"
    path.write_bytes(CONTENT)
    return path


Share = Callable[[Path], NodeFiles]


@dataclass(frozen=True, eq=False, kw_only=True)
class Yields(Scripted):
    events: Callable[[], Iterator[Event]]

    def run(self) -> Iterator[Event]:
        return self.events()


@pytest.fixture
def share(sharing: FileSharing, monkeypatch: pytest.MonkeyPatch) -> Share:
    """The scene file of a worker that finds nothing at its own path; the file server, elsewhere, does."""
    monkeypatch.setattr(Stamp, "fits", lambda *_: False)

    def share_file(path: Path) -> NodeFiles:
        return replace(sharing.share_files([path], []), home="another machine")

    return share_file


def test_a_file_that_is_there_is_read_where_it_is_and_nothing_is_reported(
    sharing: FileSharing, image: Path
) -> None:
    files = sharing.share_files([image], [])
    assert files(image) == image
    with pytest.raises(KeyError):  # of another task
        files(image.with_name("b.jpg"))

    def work() -> Iterator[Event]:
        files(image)
        yield Checkpoint(COARSE, 1, {"x": torch.zeros(5)})

    (event,) = run_remotely(Yields(locate=files, events=work))
    assert isinstance(event, Checkpoint)
    assert node_files.received_bytes() == 0


def test_a_file_that_is_not_there_comes_once_for_all_tasks(share: Share, image: Path) -> None:
    files = share(image)
    with ThreadPoolExecutor(4) as threads:
        copies = set(threads.map(files, [image] * 4))
    (copy,) = copies
    assert copy != image
    assert copy.read_bytes() == CONTENT
    assert (node_files.received_bytes(), node_files.received_bytes()) == (len(CONTENT), 0)
    later = share(image)
    assert later(image) == copy
    assert node_files.received_bytes() == 0


def test_of_a_file_that_is_replaced_a_machine_keeps_the_newest_copy(share: Share, image: Path) -> None:
    other = image.with_name("b.jpg")
    other.write_bytes(CONTENT)
    kept, folders = share(other)(other), set()
    for version in range(1, 4):  # as a checkpoint from which a task is resumed
        image.write_bytes(CONTENT * version)
        copy = share(image)(image)
        folders.add(copy.parent)
    assert [folder.exists() for folder in folders].count(True) == 1
    assert copy.stat().st_size == 3 * len(CONTENT)
    assert kept.is_file()


def test_a_disk_without_room_for_a_copy_is_an_error_of_the_system(
    share: Share, image: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    usage = shutil.disk_usage(image)._replace(free=len(CONTENT) - 1)
    monkeypatch.setattr(shutil, "disk_usage", lambda _: usage)
    image.write_bytes(CONTENT)
    os.utime(image, ns=(2, 2))
    files = replace(share(image), cache="empty")
    with pytest.raises(OSError, match=r"a\.jpg: 256,000 bytes are needed and 255,999 are free"):
        files(image)


def test_copies_leave_a_part_of_the_disk_free(
    share: Share, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The least recently used go, as those of blocks that are done; what was used just now stays."""
    size, copies = len(CONTENT), dict[int, Path]()

    def usage(folder: Path) -> Any:  # of a disk for six files, which leaves room for five
        used = size * sum(copy.exists() for copy in copies.values())
        return real(folder)._replace(total=6 * size, free=6 * size - used)

    real = shutil.disk_usage
    monkeypatch.setattr(shutil, "disk_usage", usage)
    for number in range(8):
        path = tmp_path / f"{number}.jpg"
        path.write_bytes(CONTENT)
        copies[number] = replace(share(path), cache="bounded")(path)
        hour = 3600 * (24 - number)
        if number < 6 and number != 1:  # 1 is in use
            os.utime(copies[number].parent / "lock", (time.time() - hour,) * 2)
    assert [number for number, copy in copies.items() if copy.exists()] == [1, 4, 5, 6, 7]


def test_a_large_file_comes_in_pieces(share: Share, image: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(node_files, "_PIECE", len(CONTENT) // 3 + 1)
    files = share(image)
    assert files(image).read_bytes() == CONTENT
    assert node_files.received_bytes() == len(CONTENT)


def test_a_file_that_has_changed_or_gone_is_refused(share: Share, image: Path) -> None:
    files = share(image)
    image.write_bytes(b"shorter")
    with pytest.raises(RunError, match=r"a\.jpg: has changed on the driver's machine"):
        files(image)
    image.unlink()
    with pytest.raises(RunError, match=r"a\.jpg: has changed on the driver's machine"):
        files(image)
    with pytest.raises(FileNotFoundError):
        share(image)


def test_a_file_server_that_hangs_is_ended_and_another_one_serves(
    share: Share, sharing: FileSharing, image: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The driver does not wait for its answer, and one that answers stays."""
    files, process = share(image), sharing._process.read_text
    sharing.suspect()
    ray.get(files.server.answer.remote())
    first = process()

    def answered() -> bool:
        sharing.review()
        return sharing._asked is None

    wait_until(answered, "the answer")
    assert process() == first
    os.kill(int(first), signal.SIGSTOP)
    sharing.suspect()
    sharing.review()  # it has time
    assert sharing._asked is not None
    sharing._asked = None
    monkeypatch.setattr(node_files, "_ANSWER_S", 0.0)
    sharing.suspect()
    sharing.review()
    assert files(image).read_bytes() == CONTENT


def test_a_file_of_a_scene_in_a_store_is_left_to_the_machine_itself(
    sharing: FileSharing, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "outline" / "a.jpg"
    stored = Stored("s3://places/town", "images/a.jpg", Version(9, "tag", 0.0))
    with monkeypatch.context() as patch:
        patch.setattr(node_files, "stored_of", lambda _: stored)
        files = sharing.share_files([path], [])
    assert stored_of(path) is None  # as on another machine
    assert files(path) == path
    assert stored_of(path) == stored


def test_a_value_that_the_machine_has_does_not_travel(sharing: FileSharing) -> None:
    value: RayValue[bytes] = RayValue(ray.put(CONTENT), home="another machine")
    assert value.load() == CONTENT
    assert node_files.received_bytes() == 0


def test_bytes_are_reported_with_milestones_and_when_they_have_doubled(share: Share, image: Path) -> None:
    files = share(image)
    progress = Progress(COARSE, 1, 9, 1.0)
    checkpoint = Checkpoint(COARSE, 1, {"x": torch.zeros(5)})

    def work() -> Iterator[Event]:
        files(image)
        yield progress
        node_files._RECEIVED.append(100)
        yield progress
        yield checkpoint
        node_files._RECEIVED.append(2 * len(CONTENT))
        yield progress
        yield Preview(COARSE, 1, "a.jpg", b"jpeg")

    events = list(run_remotely(Yields(locate=files, events=work)))
    transfers = [event for event in events if isinstance(event, Transfer)]
    assert transfers == [
        Transfer(COARSE, len(CONTENT), 0),
        Transfer(COARSE, 100, 20),
        Transfer(COARSE, 2 * len(CONTENT), 0),
        Transfer(COARSE, 0, 4),
    ]
    assert [events.index(event) for event in transfers] == [0, 3, 5, 7]


def test_a_worker_is_not_silent_while_large_files_arrive(
    share: Share, image: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(node_files, "_PIECE", 1000)
    monkeypatch.setattr(node_files, "_SIGN_S", 0.001)
    files = share(image)
    made = replace(files, stamps={image: Stamp.of(image, dated=True)}, cache="made")

    def work() -> Iterator[Event]:
        assert made(image).read_bytes() == CONTENT
        yield Checkpoint(COARSE, 1, {})

    *signs, transfer, checkpoint = run_remotely(Yields(locate=made, events=work))
    assert signs
    assert all(isinstance(sign, Usage) for sign in signs)
    assert transfer == Transfer(COARSE, len(CONTENT), 0)
    assert isinstance(checkpoint, Checkpoint)


def test_a_stamp_needs_the_size_and_for_files_of_the_run_the_date(image: Path) -> None:
    assert Stamp.of(image, dated=False) == Stamp(len(CONTENT))
    dated = Stamp.of(image, dated=True)
    assert dated.fits(image)
    assert not replace(dated, modified=1).fits(image)
    assert not Stamp(len(CONTENT) + 1).fits(image)
    assert not dated.fits(image.with_name("b.jpg"))
