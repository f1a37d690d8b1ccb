"""How views get to a GPU: which threads, in which order, how many of them. The GPU is CPU tensors."""

import threading
import weakref
from collections import Counter
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torch import Tensor

from panolog.scene import image_files, images
from panolog.scene.errors import ImageError
from panolog.scene.images import PanoramaCache, View, load_view, passing_views
from panolog.scene.model import Scene
from panolog.scene.read import read_scene
from panolog.scene.tensors import transfer
from panolog.scene.tensors.transfer import Mover, Moving
from tests.on_device import needs_a_card
from tests.renderer.cuda.fake_cuda import Torch
from tests.scenes import HEIGHT, WIDTH, write_scene

VIEW = 3 * WIDTH * HEIGHT  # bytes of a view without layers
ROWS = range(6)
EPOCHS = [[0, 3, 5, 1, 2, 4], [4, 2, 0, 5, 3, 1], [1, 0, 2, 3, 4, 5]]


@pytest.fixture
def scene(tmp_path: Path) -> Scene:
    return read_scene(write_scene(tmp_path / "scene", names=[f"{i}.png" for i in ROWS]))


@pytest.fixture
def layered(tmp_path: Path) -> Scene:
    """With masks, sky masks and depth maps of an odd number of rows of their own."""
    root = write_scene(tmp_path / "layered", names=[f"{i}.png" for i in ROWS])
    random = np.random.default_rng(1)
    for folder, kind in (("masks", np.uint8), ("skymasks", np.uint8), ("depths", np.uint16)):
        (root / folder).mkdir(exist_ok=True)
        for row in ROWS:
            pixels: NDArray[Any] = random.integers(0, np.iinfo(kind).max, (HEIGHT, WIDTH), kind)
            cv2.imwrite(str(root / folder / f"{row}.png"), pixels)
    return read_scene(root)


class Recorder(Mover):
    """Moves views to copies of their tensors, and says what it was called for."""

    def __init__(self, scene: Scene) -> None:
        views = (load_view(scene.panoramas[row], row, WIDTH) for row in ROWS)
        self._rows = {view.image.numpy().tobytes(): view.row for view in views}
        self.staged: Counter[int] = Counter()
        self.threads: set[str] = set()
        self.finished: list[int] = []
        self.here = self.most = 0  # views on the device: now, and at most
        self._lock = threading.RLock()

    def begin(self, layout: Mapping[str, Tensor], fill: Callable[[Tensor], None]) -> Moving:
        with self._lock:
            self.staged[self._row(layout)] += 1
            self.threads.add(threading.current_thread().name)
            self.here += 1
            self.most = max(self.most, self.here)
        moved = {name: layer.clone() for name, layer in layout.items()}
        weakref.finalize(moved["image"], self._gone)
        return Moving(moved)

    def end(self, moving: Moving) -> dict[str, Tensor]:
        assert threading.current_thread() is threading.main_thread()
        self.finished.append(self._row(moving.tensors))
        return moving.tensors

    def _row(self, tensors: Mapping[str, Tensor]) -> int:
        return self._rows[tensors["image"].numpy().tobytes()]

    def _gone(self) -> None:
        with self._lock:
            self.here -= 1


def run(scene: Scene, recorder: Recorder, *, budget: int, room: int, threads: int) -> None:
    """Three epochs, requested ahead as training does."""
    order = [row for epoch in EPOCHS for row in epoch]
    with PanoramaCache(
        scene, ROWS, WIDTH, budget, device="cuda", room=room, threads=threads, mover=recorder
    ) as cache:
        for step, row in enumerate(order):
            cache.prefetch(order[step : step + 1 + cache.ahead(4)])
            expected = load_view(scene.panoramas[row], row, WIDTH).image
            assert torch.equal(cache.get(row).image, expected)
    assert recorder.finished == order


@pytest.mark.parametrize(
    ("budget", "room", "again", "threads"),
    [(0, 6 * VIEW, False, 3), (6 * VIEW, 2 * VIEW + 1, False, 1), (6 * VIEW, 0, False, 3), (1, 0, True, 1)],
)
def test_threads_that_decode_views_move_them_and_do_so_again_only_where_there_is_no_room(
    scene: Scene, monkeypatch: pytest.MonkeyPatch, budget: int, room: int, again: bool, threads: int
) -> None:
    """Room on the device for all, or for two while the host holds the others, or on the host, or nowhere."""
    decoded: Counter[int] = Counter()

    def counted(panorama: Any, row: int, *rest: Any) -> View:
        decoded[row] += 1
        return load_view(panorama, row, *rest)

    monkeypatch.setattr(images, "load_view", counted)
    recorder = Recorder(scene)
    run(scene, recorder, budget=budget, room=room, threads=threads)
    assert recorder.threads <= {f"decode_{i}" for i in range(threads)}
    assert (max(decoded.values()) > 1) == again
    staying = room // VIEW
    moves = [recorder.staged[row] for row in EPOCHS[0]]
    assert moves[:staying] == [1] * staying and (max(moves) > 1) == (staying < len(ROWS))
    assert recorder.most <= staying + passing_views(threads) + 1  # one more until its last user lets it go


def test_layers_are_decoded_once_although_views_have_no_room(
    layered: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each picture is decoded in each epoch; of layers as many stay as there is room for."""
    files, recorder = Counter[str](), Recorder(layered)

    def counted(path: Path, *rest: Any) -> NDArray[Any]:
        files[path.parent.name] += 1
        return decoded(path, *rest)

    decoded = image_files._decoded
    monkeypatch.setattr(image_files, "_decoded", counted)
    order, view = [row for epoch in EPOCHS for row in epoch], 9 * WIDTH * HEIGHT
    expected = {row: load_view(layered.panoramas[row], row, WIDTH).layers() for row in ROWS}
    found: list[list[int]] = []
    for budget in (0, view, 6 * view - 1):
        files.clear()
        with PanoramaCache(layered, ROWS, WIDTH, budget, device="cuda", mover=recorder) as cache:
            for row in order:
                for name, layer in cache.get(row).layers().items():
                    assert torch.equal(layer, expected[row][name]), name
        found.append([files[folder] for folder in ("masks", "skymasks", "depths")])
    none, some, every = found
    assert every == [len(ROWS)] * 3
    assert sum(every) < sum(some) < sum(none)


def test_a_damaged_image_is_named_by_get_although_it_never_gets_to_the_device(scene: Scene) -> None:
    rooms = {0: Recorder(scene), 6 * VIEW: Recorder(scene)}
    scene.panoramas[1].image.write_bytes(b"\x89PNG\r\n\x1a\n and no more")
    for room, recorder in rooms.items():
        with PanoramaCache(scene, ROWS, WIDTH, 6 * VIEW, device="cuda", room=room, mover=recorder) as cache:
            for _ in range(2):
                with pytest.raises(ImageError, match=r"1\.png"):
                    cache.get(1)
            assert torch.equal(cache.get(0).image, load_view(scene.panoramas[0], 0, WIDTH).image)
        assert set(recorder.staged) == {0}


# CudaMover, with a torch whose GPU is the CPU


@pytest.fixture
def cuda(monkeypatch: pytest.MonkeyPatch) -> Torch:
    fake = Torch()
    monkeypatch.setattr(transfer, "torch", fake)
    return fake


def test_a_view_is_copied_on_a_stream_of_its_own_and_only_the_device_waits(
    layered: Scene, cuda: Torch
) -> None:
    with PanoramaCache(layered, ROWS, WIDTH, 100 * VIEW, device="cuda", threads=1) as cache:
        for row in ROWS:
            view = cache.get(row)
            expected = load_view(layered.panoramas[row], row, WIDTH).layers()
            assert len(expected) == 4
            for name, layer in view.layers().items():
                assert torch.equal(layer, expected[name]), name
    one = ["stream uploads", "copy", "event on uploads"]
    taken = ["training waits", "memory used by namespace"]
    log = [entry.split("(")[0] for entry in cuda.log]
    assert log[:5] == one + taken
    assert log[5:] == 5 * ["decode_0 waits", *one, *taken]  # before it fills its buffer again
    assert len(cuda.pinned) == 1  # one buffer of one thread


@needs_a_card
@pytest.mark.parametrize("room", [0, 2 * VIEW, 100 * VIEW])
def test_on_a_card_views_are_equal_and_the_host_does_not_wait(layered: Scene, room: int) -> None:
    order = [row for epoch in EPOCHS for row in epoch]
    expected = {row: load_view(layered.panoramas[row], row, WIDTH).layers() for row in ROWS}
    wrong = torch.zeros((), dtype=torch.int64, device="cuda")
    with PanoramaCache(layered, ROWS, WIDTH, 100 * VIEW, device="cuda", room=room, threads=4) as cache:
        device = {row: {n: t.cuda() for n, t in layers.items()} for row, layers in expected.items()}
        for step, row in enumerate(order):
            cache.prefetch(order[step : step + 5])
            torch.cuda.set_sync_debug_mode("error")
            view = cache.get(row)
            torch.cuda.set_sync_debug_mode("default")
            for name, layer in view.layers().items():
                wrong += (layer != device[row][name]).sum()
    assert int(wrong) == 0
