"""What surrounds a block: frozen or baked, it is the same to the block."""

import gc
import logging
import tempfile
import threading
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from panolog.renderer.baked import Baked, bake
from panolog.renderer.camera import Camera
from panolog.renderer.cuda.iteration import Problem
from panolog.renderer.iteration import loss_of
from panolog.renderer.render import render
from panolog.scene.errors import RunError
from panolog.scene.gaussians import Gaussians
from panolog.scene.images import View, load_view, view_bytes
from panolog.scene.model import Scene
from panolog.scene.tensors import transfer
from panolog.workers.comparison import with_block
from panolog.workers.events import Checkpoint, Preview
from panolog.workers.specs import Value
from panolog.workers.training import iterations
from panolog.workers.training.config import TrainConfig
from panolog.workers.training.exterior import BAKED, BakedViews, Exterior, Rooms, exterior_last, inside
from panolog.workers.training.loss import Loss
from panolog.workers.training.schedule import Schedule
from panolog.workers.training.task_config import CacheConfig
from panolog.workers.training.trainer import TrainSpec, train
from tests.renderer.cuda.fake_cuda import Torch
from tests.workers.small import WIDTH, small_scene
from tests.workers.trainings import block_of, coarse_of, notices, same, stop_at, trained

USUAL: dict[str, Any] = {
    "projection": "exact",
    "sky": {"count": 60},
    "densify": {"method": "relocate", "until": 24_000, "every_floor": 5},
    "checkpoint": {"every": 7, "share": 1},
    "preview": {"every": 12, "seconds": 1e9},
}


def block(scene: Scene, initial: Gaussians, kind: str = "baked", **groups: Any) -> TrainSpec:
    """With an exterior of that kind."""
    config = TrainConfig.model_validate(USUAL | {"stage2": {"exterior": kind}} | groups)
    return block_of(coarse_of(scene, config), initial)


@pytest.fixture(scope="module")
def initial(scene: Scene) -> Gaussians:
    return trained(coarse_of(scene, TrainConfig.model_validate(USUAL)))


@pytest.fixture(scope="module")
def part(scene: Scene, initial: Gaussians) -> Gaussians:
    """A block with a baked exterior at its end."""
    return trained(block(scene, initial))


def test_a_block_ends_as_with_a_frozen_exterior(scene: Scene, initial: Gaussians, part: Gaussians) -> None:
    errors, spec = {}, block(scene, initial, "frozen")
    for kind, own in (("frozen", trained(spec)), ("baked", part)):
        assert spec.cell is not None and spec.cell.contains(own.means.numpy()).all() and own.sky == 0
        whole = with_block(initial, spec.cell, own)
        errors[kind] = error(whole, scene)
    assert errors["baked"] < 0.9 * error(initial, scene)
    assert errors["baked"] == pytest.approx(errors["frozen"], rel=0.1)


def error(model: Gaussians, scene: Scene) -> float:
    """The mean squared error of the block's panoramas."""
    views = [load_view(scene.panoramas[row], row, WIDTH) for row in (0, 2)]
    return float(np.mean([(drawn(model, scene, v.row) - v.image / 255).square().mean() for v in views]))


def around_of(model: Gaussians, room: int = 1 << 30) -> Exterior:
    return Exterior(model, 0.01, 1.0, room, torch.device("cpu"))


def drawn(model: Gaussians, scene: Scene, row: int) -> Tensor:
    return render(model, camera(scene, row), near=0.01).color


def camera(scene: Scene, row: int) -> Camera:
    panorama = scene.panoramas[row]
    return Camera.of(panorama.rotation, panorama.translation, WIDTH, WIDTH // 2)


def test_a_stop_while_it_bakes_leaves_a_checkpoint(scene: Scene, initial: Gaussians, part: Gaussians) -> None:
    task = block(scene, initial)
    *_, last = train(task, stop=lambda: True)
    assert isinstance(last, Checkpoint) and last.iteration == 1
    assert same(trained(replace(task, checkpoint=Value(last))), part)


def test_a_block_that_ends_early_leaves_neither_its_thread_nor_its_file(
    scene: Scene, initial: Gaussians, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Although the garbage collector does not run: stopped, or failed while its error is in use."""
    files: list[Any] = []
    make = tempfile.TemporaryFile

    def made(**options: Any) -> Any:
        files.append(make(**options))
        return files[-1]

    def readers() -> list[str]:
        return [it.name for it in threading.enumerate() if it.name.startswith("baked")]

    monkeypatch.setattr("panolog.workers.training.exterior.tempfile.TemporaryFile", made)
    task = block(scene, initial, cache={"memory": 1e-6})
    gc.disable()
    try:
        for steps in (1, 5):
            list(train(task, stop_at(len(task.views) + steps)))
            assert not readers() and files.pop().closed and not files
        events = train(task)
        while not readers():
            next(events)
        monkeypatch.setattr(iterations, "take", lambda *_, **__: 1 / 0)
        with pytest.raises(ZeroDivisionError):
            list(events)
        assert not readers() and files.pop().closed and not files
    finally:
        gc.enable()


def test_it_logs_what_was_baked_and_drops_the_model(
    scene: Scene, initial: Gaussians, caplog: pytest.LogCaptureFixture
) -> None:
    task = block(scene, initial)
    with caplog.at_level(logging.INFO):
        events = list(train(task))
    name = f"{task.task}: "
    baked, ended = (text.removeprefix(name) for text in caplog.messages if "baked" in text)
    assert notices(events) == []
    assert baked.startswith("baked what surrounds the block for 2 panoramas")
    assert ended.startswith("at the end the colours of what is baked differ from the full render by at most ")
    for notice, most in ((baked, 0.002), (ended, 0.02)):
        assert float(notice.split("at most ")[1].split(",")[0]) < most
    assert any(isinstance(event, Preview) for event in events)
    exterior = around_of(exterior_last(initial, task.cell))
    exterior.of(0, camera(scene, 0))
    exterior.finish({0: camera(scene, 0)})
    assert exterior.model is None and 0 in exterior.views
    with pytest.raises(KeyError):
        exterior.of(1, camera(scene, 1))


@pytest.mark.parametrize("room", [0, 100_000, 1 << 30])
def test_what_has_no_room_is_read_back_from_a_file(scene: Scene, initial: Gaussians, room: int) -> None:
    model = exterior_last(initial, block(scene, initial).cell)
    exterior, whole = around_of(model, room), around_of(model)
    for row in (0, 1, 2):
        exterior.of(row, camera(scene, row))
    assert len(exterior.views) == 3 and 3 not in exterior.views
    for rows in ((2, 0, 1), (1, 0), (0, 2)):  # the second requests a view that is not what comes next
        exterior.views.prefetch(rows)
        for row in rows[::-1]:
            found, expected = exterior.views.get(row), whole.of(row, camera(scene, row))
            assert found.unit == expected.unit
            for name, tensor in expected.tensors().items():
                assert torch.equal(found.tensors()[name], tensor), name
    exterior.finish({row: camera(scene, row) for row in (0, 1, 2)})
    assert exterior.views.nbytes == sum(whole.of(row, camera(scene, row)).nbytes for row in (0, 1, 2))


def test_on_a_gpu_the_thread_that_reads_begins_the_copy_and_only_the_device_waits(
    scene: Scene, initial: Gaussians, monkeypatch: pytest.MonkeyPatch
) -> None:
    model, rows = exterior_last(initial, block(scene, initial).cell), (0, 1, 2)
    whole, fake = around_of(model), Torch()
    monkeypatch.setattr(transfer, "torch", fake)
    views = BakedViews(0, torch.device("cuda"))
    for row in rows:
        views.add(row, whole.of(row, camera(scene, row)))
    fake.log.clear()
    for row in rows:
        views.prefetch(rows[row:])
        assert views.get(row) is views.get(row)
        for name, tensor in whole.of(row, camera(scene, row)).tensors().items():
            assert torch.equal(views.get(row).tensors()[name], tensor), name
    views.close()
    log = [entry.split("(")[0] for entry in fake.log]
    taken = ["training waits", "memory used by namespace"]
    assert [entry for entry in log if entry in taken] == taken * len(rows)
    one = ["stream uploads", "copy", "event on uploads", "baked_0 waits"]  # before it fills its buffer again
    assert [entry for entry in log if entry not in taken] == (one * len(rows))[:-1]
    assert len(fake.pinned) <= len(rows)  # one buffer of one thread, which grows


def test_a_gpu_without_room_for_the_whole_model_leaves_it_to_the_cpu(
    scene: Scene, initial: Gaussians, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The GPU has room for one view; an error other than want of memory ends the task."""
    where: list[str] = []
    message = "CUDA driver error: out of memory"

    def to(model: Gaussians, device: torch.device) -> Gaussians:
        where.append(device.type)
        return model

    def on_device(*arguments: Any, **named: Any) -> Baked:
        if where[1:] and where[-1] == "cuda":
            raise RuntimeError(message)
        return bake(*arguments, **named)

    model = exterior_last(initial, block(scene, initial).cell)
    expected = around_of(model)
    views = {row: expected.of(row, camera(scene, row)) for row in (0, 1, 2)}
    monkeypatch.setattr(transfer, "torch", Torch())
    monkeypatch.setattr(Gaussians, "to", to)
    monkeypatch.setattr("panolog.workers.training.exterior.bake", on_device)
    exterior = Exterior(model, 0.01, 1.0, 0, torch.device("cuda"))
    for row, view in views.items():
        found = exterior.of(row, camera(scene, row)).tensors()
        assert all(torch.equal(found[name], tensor) for name, tensor in view.tensors().items())
    assert where == ["cuda", "cuda", "cpu", "cpu"]
    exterior.views.close()
    message, where[:] = "the launch failed", ["cuda"]
    exterior = Exterior(model, 0.01, 1.0, 0, torch.device("cuda"))
    with pytest.raises(RuntimeError, match="the launch failed"):
        exterior.of(0, camera(scene, 0))
    exterior.views.close()


def test_a_full_disk_says_what_to_do(
    scene: Scene, initial: Gaussians, monkeypatch: pytest.MonkeyPatch
) -> None:
    model = exterior_last(initial, block(scene, initial).cell)
    full = lambda **_: Path("/dev/full").open("wb", buffering=0)  # noqa: E731, SIM115
    monkeypatch.setattr("panolog.workers.training.exterior.tempfile.TemporaryFile", full)
    with pytest.raises(RunError, match=r"No space left on device.*set TMPDIR"):
        around_of(model, room=0).of(0, camera(scene, 0))


def test_panoramas_and_what_is_baked_share_the_cache(scene: Scene) -> None:
    panorama = scene.panoramas[0]
    view, baked = view_bytes(panorama, 512), BAKED * 512 * 256
    cache = CacheConfig(memory=10 * (view + baked) / 2**30, device=(view + baked) / 2**30)
    host, device = int(cache.memory * 2**30), int((cache.device or 0) * 2**30)
    assert Rooms.of(cache, "cpu", panorama, 512, bakes=False) == Rooms(host, device, 0)
    on_cpu, on_gpu = (Rooms.of(cache, kind, panorama, 512, bakes=True) for kind in ("cpu", "cuda"))
    assert on_cpu.host + on_cpu.baked == host and on_cpu.device == 0
    assert on_cpu.baked == pytest.approx(10 * baked, abs=2) and on_cpu.host == pytest.approx(10 * view, abs=2)
    assert on_gpu.host == host and on_gpu.device + on_gpu.baked == device
    assert on_gpu.baked == pytest.approx(baked, abs=2)
    less = Rooms.of(cache, "cuda", panorama, 512, bakes=True, taken=device // 2)
    assert less.host == host and less.device + less.baked == device - device // 2
    assert Rooms.of(cache, "cuda", panorama, 512, bakes=True, taken=2 * device) == Rooms(host, 0, 0)


def problem(scene: Scene, model: Gaussians, view: View, loss: Loss, around: Baked | None) -> Problem:
    """A view with its depth at a weight of 0.3."""
    return Problem(
        model=model.tensors(),
        camera=camera(scene, view.row),
        image=view.image,
        **loss.targets(view, 0.3, around)._asdict(),
        depth_weight=0.3,
        lambda_ssim=0.0,
        rows=None,
        sh_degree=3,
        near=0.01,
    )


def gradients(
    scene: Scene, model: Gaussians, view: View, config: TrainConfig, around: Baked | None
) -> tuple[float, Tensor, Tensor]:
    """The loss, and its gradients by colours and inverse depths."""
    image = render(model, camera(scene, view.row), near=0.01)
    loss = Loss(scene, config, 0, Schedule(config, 24, 1.0, refine=True))
    found = loss_of(problem(scene, model, view, loss, around), image.color, image.inverse_depth)
    return found.value, found.by_color, found.by_inverse_depth


def test_the_loss_of_active_pixels_has_the_gradient_of_all(tmp_path: Path, initial: Gaussians) -> None:
    """Of L1 and of depth: what is left out is constant. SSIM has windows that reach over the rim."""
    scene = small_scene(tmp_path)
    spec = block(scene, initial, loss={"lambda_ssim": 0.0})
    view = load_view(scene.panoramas[0], 0, WIDTH)
    assert view.mask is not None and view.inverse_depth is not None
    around = around_of(exterior_last(initial, spec.cell)).of(0, camera(scene, 0))
    around.places[5:] = -1  # most tiles
    active = around.active(WIDTH, WIDTH // 2)
    assert 0 < float(active.float().mean()) < 1
    _, *whole = gradients(scene, initial, view, spec.config, None)
    _, *parts = gradients(scene, initial, view, spec.config, around)
    for expected, part in zip(whole, parts, strict=True):
        assert part.any()
        assert torch.allclose(part[active], expected[active], rtol=1e-4, atol=1e-9)
        assert not part[~active].any()
    around.places[:] = -1  # a view that sees nothing of the block changes nothing
    value, color, _ = gradients(scene, initial, view, spec.config, around)
    assert value == 0 and not color.any()


def test_a_cell_without_gaussians_stays_empty(scene: Scene, initial: Gaussians) -> None:
    spec = block(scene, initial)
    within = torch.zeros(len(initial), dtype=torch.bool)
    within[initial.scene] = torch.from_numpy(inside(initial, spec.cell))
    assert len(trained(replace(spec, initial=Value(initial.select(~within))))) == 0
