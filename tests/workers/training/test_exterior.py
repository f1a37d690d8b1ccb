"""What surrounds a block: frozen or baked, it is the same to the block."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from panolog.partition.bounds import aabb
from panolog.partition.cells import Cell, Grid
from panolog.renderer.baked import Baked
from panolog.renderer.camera import Camera
from panolog.renderer.cuda.iteration import Problem
from panolog.renderer.render import render
from panolog.scene.errors import RunError
from panolog.scene.gaussians import Gaussians
from panolog.scene.images import View, load_view, view_bytes
from panolog.scene.model import Scene
from panolog.workers.comparison import with_block
from panolog.workers.events import Checkpoint, Event, Notice, Preview, Trained
from panolog.workers.sound_views import open_cache
from panolog.workers.specs import Value
from panolog.workers.tasks import COARSE, TaskId
from panolog.workers.training.config import CacheConfig, TrainConfig
from panolog.workers.training.exterior import BAKED, Exterior, Rooms, exterior_last
from panolog.workers.training.loss import Loss, loss_of
from panolog.workers.training.schedule import Schedule
from panolog.workers.training.trainer import Trainer, TrainSpec, train
from tests.workers.small import WIDTH, small_scene

ITERATIONS = 24


def config(kind: str, **groups: dict[str, object]) -> TrainConfig:
    return TrainConfig.model_validate(
        {
            "projection": "exact",
            "sky": {"count": 60},
            "densify": {"method": "relocate", "until": 24_000, "every_floor": 5},
            "stage2": {"exterior": kind},
            "checkpoint": {"every": 7, "share": 1.0},
            "preview": {"every": 12},
            **groups,
        }
    )


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    return small_scene(tmp_path_factory.mktemp("scene"))


@pytest.fixture(scope="module")
def initial(scene: Scene) -> Gaussians:
    spec = TrainSpec(
        task=COARSE,
        scene=Value(scene),
        views=scene.train,
        width=WIDTH,
        iterations=ITERATIONS,
        config=config("full"),
        seed=3,
    )
    return trained(list(train(spec)))


def trained(events: Sequence[Event]) -> Gaussians:
    last = events[-1]
    assert isinstance(last, Trained)
    return last.gaussians


def block(scene: Scene, initial: Gaussians, settings: TrainConfig) -> TrainSpec:
    return TrainSpec(
        task=TaskId.block(1),
        scene=Value(scene),
        views=(0, 2),
        width=WIDTH,
        iterations=ITERATIONS,
        config=settings,
        seed=3,
        initial=Value(initial),
        cell=Cell(aabb(scene.centers, 5.0), Grid((2, 1, 1)), 1),
    )


def after_one_step(spec: TrainSpec, scene: Scene) -> tuple[Gaussians, dict[str, Tensor]]:
    """Gaussians and first moments."""
    with open_cache(spec, scene, spec.views, 1 << 30, 0) as cache:
        trainer = Trainer(spec, scene, cache)
        trainer.begin()
        list(trainer.surround(lambda: False))
        list(trainer.run(lambda: True))
    return trainer.state.gaussians, trainer.state.exp_avg


def test_a_step_is_that_with_a_frozen_exterior(scene: Scene, initial: Gaussians) -> None:
    """With all pixels active; a window of SSIM that reaches over the rim would see something else."""
    (frozen, expected), (own, found) = (
        after_one_step(block(scene, initial, config(kind)), scene) for kind in ("frozen", "baked")
    )
    count = frozen.scene.stop
    assert len(own) == count and own.sky == 0
    assert len(frozen) == len(initial)
    for name, moment in found.items():
        truth = expected[name][:count]
        assert (moment - truth).norm() <= 0.02 * truth.norm(), name


def test_a_block_ends_as_with_a_frozen_exterior(scene: Scene, initial: Gaussians) -> None:
    views = [load_view(scene.panoramas[row], row, WIDTH) for row in (0, 2)]
    errors = {}
    for kind in ("frozen", "baked"):
        spec = block(scene, initial, config(kind))
        part = trained(list(train(spec)))
        assert spec.cell is not None and spec.cell.contains(part.means.numpy()).all() and part.sky == 0
        whole = with_block(initial, spec.cell, part)
        errors[kind] = float(
            np.mean([(drawn(whole, scene, view.row) - view.image / 255).square().mean() for view in views])
        )
    before = float(np.mean([(drawn(initial, scene, v.row) - v.image / 255).square().mean() for v in views]))
    assert errors["baked"] < 0.9 * before
    assert errors["baked"] == pytest.approx(errors["frozen"], rel=0.1)


def around_of(model: Gaussians, room: int = 1 << 30) -> Exterior:
    return Exterior(model, 0.01, 1.0, room, torch.device("cpu"))


def drawn(model: Gaussians, scene: Scene, row: int) -> Tensor:
    return render(model, camera(scene, row), near=0.01).color


def camera(scene: Scene, row: int) -> Camera:
    panorama = scene.panoramas[row]
    return Camera.of(panorama.rotation, panorama.translation, WIDTH, WIDTH // 2)


@pytest.mark.parametrize("method", ["clone-split", "relocate"])
def test_resume_equals_undisturbed_byte_for_byte(scene: Scene, initial: Gaussians, method: str) -> None:
    densify = {"method": method, "until": 24_000, "every_floor": 5}
    task = block(scene, initial, config("baked", densify=densify))
    events = list(train(task))
    saved = [event for event in events if isinstance(event, Checkpoint)]
    assert len(saved) > 1
    for checkpoint in saved:
        again = trained(list(train(replace(task, checkpoint=Value(checkpoint)))))
        for name, tensor in again.tensors().items():
            assert tensor.numpy().tobytes() == trained(events).tensors()[name].numpy().tobytes(), name


def test_a_stop_while_it_bakes_leaves_a_checkpoint(scene: Scene, initial: Gaussians) -> None:
    task = block(scene, initial, config("baked"))
    *_, last = train(task, stop=lambda: True)
    assert isinstance(last, Checkpoint) and last.iteration == 1
    ours = trained(list(train(replace(task, checkpoint=Value(last)))))
    theirs = trained(list(train(task)))
    assert all(map(torch.equal, ours.tensors().values(), theirs.tensors().values()))


def test_it_reports_what_was_baked_and_drops_the_model(scene: Scene, initial: Gaussians) -> None:
    task = block(scene, initial, config("baked"))
    events = list(train(task))
    (notice,) = (event.message for event in events if isinstance(event, Notice))
    assert notice.startswith("baked what surrounds the block for 2 panoramas")
    assert float(notice.split("at most ")[1].split(",")[0]) < 0.002
    assert any(isinstance(event, Preview) for event in events)
    exterior = around_of(exterior_last(initial, task.cell))
    exterior.of(0, camera(scene, 0))
    exterior.finish({0: camera(scene, 0)})
    assert exterior.model is None and 0 in exterior.views
    with pytest.raises(KeyError):
        exterior.of(1, camera(scene, 1))


@pytest.mark.parametrize("room", [0, 100_000, 1 << 30])
def test_what_has_no_room_is_read_back_from_a_file(scene: Scene, initial: Gaussians, room: int) -> None:
    model = exterior_last(initial, block(scene, initial, config("baked")).cell)
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


def test_a_block_ends_with_the_same_bytes_whatever_the_cache(scene: Scene, initial: Gaussians) -> None:
    ends = []
    for memory in (1e-6, 4.0):
        spec = block(scene, initial, config("baked", cache={"memory": memory}))
        ends.append(trained(list(train(spec))).tensors())
    for name, tensor in ends[0].items():
        assert torch.equal(tensor, ends[1][name]), name


def test_a_full_disk_says_what_to_do(
    scene: Scene, initial: Gaussians, monkeypatch: pytest.MonkeyPatch
) -> None:
    model = exterior_last(initial, block(scene, initial, config("baked")).cell)
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


def problem(scene: Scene, model: Gaussians, view: View, loss: Loss, around: Baked | None) -> Problem:
    """A view with its depth at a weight of 0.3."""
    return Problem(
        model=model.tensors(),
        camera=camera(scene, view.row),
        image=view.image,
        **loss.targets(view, 0.3, around)._asdict(),
        depth_weight=0.3,
        lambda_ssim=0.0,
        rows=loss.rows(view),
        sh_degree=3,
        near=0.01,
    )


def test_the_loss_of_active_pixels_has_the_gradient_of_all(tmp_path: Path, initial: Gaussians) -> None:
    """Of L1 and of depth: what is left out is constant. SSIM has windows that reach over the rim."""
    scene = small_scene(tmp_path)
    spec = block(scene, initial, config("baked", loss={"lambda_ssim": 0.0}))
    view = load_view(scene.panoramas[0], 0, WIDTH)
    assert view.mask is not None and view.inverse_depth is not None
    model = exterior_last(initial, spec.cell)
    around = around_of(model).of(0, camera(scene, 0))
    around.places[5:] = -1  # most tiles
    active = around.active(WIDTH, WIDTH // 2)
    assert 0 < float(active.float().mean()) < 1
    image = render(initial, camera(scene, 0), near=0.01)
    gradients = []
    for exterior in (None, around):
        color, depth = (tensor.clone().requires_grad_() for tensor in (image.color, image.inverse_depth))
        loss = Loss(scene, spec.config, 0, Schedule(spec.config, ITERATIONS, 1.0, refine=True))
        rendered = image._replace(color=color, inverse_depth=depth)
        value = loss_of(rendered, problem(scene, initial, view, loss, exterior)).loss
        value.backward()  # type: ignore[no-untyped-call]
        gradients.append((color.grad, depth.grad))
    for whole, part in zip(*gradients, strict=True):
        assert whole is not None and part is not None and part.any()
        assert torch.allclose(part[active], whole[active], rtol=1e-4, atol=1e-9)
        assert not part[~active].any()


def test_a_view_that_sees_nothing_of_the_block_changes_nothing(scene: Scene, initial: Gaussians) -> None:
    spec = block(scene, initial, config("baked"))
    view = load_view(scene.panoramas[0], 0, WIDTH)
    around = around_of(exterior_last(initial, spec.cell)).of(0, camera(scene, 0))
    around.places[:] = -1
    image = render(initial, camera(scene, 0), near=0.01)
    color = image.color.clone().requires_grad_()
    loss = Loss(scene, spec.config, 0, Schedule(spec.config, ITERATIONS, 1.0, refine=True))
    value = loss_of(image._replace(color=color), problem(scene, initial, view, loss, around)).loss
    value.backward()  # type: ignore[no-untyped-call]
    assert value.item() == 0
    assert color.grad is not None and not color.grad.any()


def test_a_cell_without_gaussians_stays_empty(scene: Scene, initial: Gaussians) -> None:
    spec = block(scene, initial, config("baked"))
    assert spec.cell is not None
    inside = torch.zeros(len(initial), dtype=torch.bool)
    inside[initial.scene] = torch.from_numpy(spec.cell.contains(initial.means[initial.scene].numpy()))
    events = list(train(replace(spec, initial=Value(initial.select(~inside)))))
    assert len(trained(events)) == 0
