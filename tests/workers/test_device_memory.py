"""What is said of a GPU's memory, against the tensors that live in the code that runs there.

Tensors on torch's device "meta" have no memory. Ops run as on a card, by `renderer.cuda.launches`, but no
kernel does.
"""

import weakref
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any
from unittest import mock

import pytest
import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from panolog.renderer import ops
from panolog.renderer.baked import bake
from panolog.renderer.camera import Camera
from panolog.renderer.cuda import launches
from panolog.renderer.losses import photometric_loss
from panolog.renderer.render import render, render_panorama
from panolog.scene.gaussians import Gaussians
from panolog.scene.images import PanoramaCache, View
from panolog.scene.model import Scene
from panolog.scene.random_streams import generator
from panolog.scene.tensors.transfer import packed_bytes, unpack
from panolog.workers import device_memory
from panolog.workers.training.config import TrainConfig
from panolog.workers.training.densify import Statistics, densify
from panolog.workers.training.iterations import AHEAD
from panolog.workers.training.optimizer import ModelState
from panolog.workers.training.trainer import Trainer
from tests.renderer.cuda.stubbed import no_launch
from tests.workers.small import WIDTH
from tests.workers.trainings import coarse_of

ITERATION = 8_000  # of 30,000: all harmonics are in use, and screen gradients are collected
SIZES = [(100_000, 1024), (100_000, 4096), (1_000_000, 2048), (10_000_000, 2048), (10_000_000, 4096)]

aten = torch.ops.aten
DEVICE = "meta"
_BLOCK = 512  # bytes: torch's allocator rounds up to them


class CountedMemory(TorchDispatchMode):  # type: ignore[no-untyped-call]
    """Within it, the live bytes of all tensors of `DEVICE`: each storage counts until nothing holds it.

    What depends on values has a size that is given: `pairs` of splats and tiles, and `chosen`, the fraction
    of rows that each `nonzero` finds.
    """

    def __init__(self, pairs: int = 0, chosen: float = 0.0) -> None:
        super().__init__()  # type: ignore[no-untyped-call]
        self.pairs, self.chosen = pairs, chosen
        self.live = self.peak = 0  # bytes
        self._known: set[int] = set()

    def restart(self) -> None:
        """The peak is now what is live."""
        self.peak = self.live

    def __torch_dispatch__(
        self, func: Any, types: Any, args: tuple[Any, ...] = (), kwargs: Mapping[str, Any] | None = None
    ) -> Any:
        kwargs = kwargs or {}
        if func.namespace == "panolog":
            with self:
                op = func.__name__.split(".")[0]
                return getattr(launches, op)(no_launch, **ops.named(op, args), **kwargs)
        if func in (aten.item.default, aten._local_scalar_dense.default) and args[0].is_meta:
            return 1.0 if args[0].is_floating_point() else self.pairs
        if (
            func is aten.copy_.default and not args[0].is_meta and args[1].is_meta
        ):  # the report of an iteration
            return args[0].copy_(torch.tensor([0.0, 0.0, self.pairs, 0.0]))
        if func is aten._to_copy.default and args[0].is_meta and _to_host(kwargs):
            found = aten.empty_like(args[0], device="cpu")  # memory that is not touched takes none
            return found.zero_() if found.numel() < _BLOCK else found
        if func is aten.nonzero.default and args[0].is_meta:
            found = args[0].new_empty((int(len(args[0]) * self.chosen), args[0].dim()), dtype=torch.int64)
        else:
            found = func(*args, **kwargs)
        for tensor in tree_leaves(found):
            if isinstance(tensor, Tensor) and tensor.is_meta:
                self._count(tensor.untyped_storage())
        if func is aten.sort.stable:
            self.peak = max(self.peak, self.live + _sort_buffers(args[0]))
        return found

    def _count(self, storage: torch.UntypedStorage) -> None:
        if storage._cdata in self._known:
            return
        self._known.add(storage._cdata)
        size = -(-storage.nbytes() // _BLOCK) * _BLOCK
        self.live += size
        self.peak = max(self.peak, self.live)
        weakref.finalize(storage, self._free, storage._cdata, size)

    def _free(self, storage: int, size: int) -> None:
        self._known.remove(storage)
        self.live -= size


def _to_host(kwargs: Mapping[str, Any]) -> bool:
    device = kwargs.get("device")
    return device is not None and torch.device(device).type == "cpu"


def _sort_buffers(keys: Tensor) -> int:
    """Bytes that torch.sort of one long row allocates besides its results.

    As in aten/src/ATen/native/cuda/Sort.cu: indices from 0, int64; and CUB's buffers of keys and of indices.
    """
    return len(keys) * (8 + keys.element_size() + 8)


def empty(*shape: int, dtype: torch.dtype = torch.float32) -> Tensor:
    return torch.empty(shape, dtype=dtype, device=DEVICE)


def model(count: int) -> Gaussians:
    shapes = {"means": (3,), "quats": (4,), "scales": (3,), "opacities": (), "sh0": (1, 3), "shN": (15, 3)}
    tensors = {name: empty(count, *shape) for name, shape in shapes.items()}
    return Gaussians(**tensors, sky=count // 100, exact=True)


def view(width: int) -> View:
    """With all its layers, which are parts of one tensor as `CudaMover` makes them."""
    size = (width // 2, width)
    mask, sky = (empty(*size, dtype=torch.bool) for _ in range(2))
    seen = View(0, empty(*size, 3, dtype=torch.uint8), mask, sky, empty(*size))
    memory = empty(packed_bytes(seen.layers()), dtype=torch.uint8)
    return View(0, **unpack(memory, seen.layers()))


@contextmanager
def training(scene: Scene, count: int, width: int, chosen: float) -> Iterator[tuple[Trainer, CountedMemory]]:
    """A trainer of so many Gaussians, in counted memory."""
    spec = coarse_of(scene, TrainConfig(), width=width, iterations=30_000, device=DEVICE)
    memory = CountedMemory(device_memory.pairs(count, width * width // 2), chosen)
    on_card = mock.patch.object(ops, "launcher", return_value=no_launch)
    with PanoramaCache(scene, scene.train, WIDTH, 2**20) as cache, on_card, memory:
        trainer = Trainer(spec, scene, cache)
        trainer.state = ModelState.start(model(count))
        trainer.statistics = Statistics.zeros(trainer.state.gaussians.scene.stop, DEVICE, spec.config.densify)
        yield trainer, memory


@pytest.mark.parametrize(("count", "width"), SIZES)
def test_an_iteration(scene: Scene, count: int, width: int, monkeypatch: pytest.MonkeyPatch) -> None:
    size = (width // 2, width)
    with training(scene, count, width, 0.0) as (trainer, memory):
        monkeypatch.setattr(trainer.loss.depth, "target", lambda _: None)
        trainer.step(ITERATION, view(width))  # afterwards the number of pairs is known
        target = empty(*size), empty(*size, dtype=torch.bool)
        monkeypatch.setattr(trainer.loss.depth, "target", lambda _: target)
        memory.restart()
        for iteration in range(1, AHEAD + 2):
            trainer.step(ITERATION + iteration, view(width))
    need = device_memory.training(count, width * width // 2)
    assert need == pytest.approx(memory.peak, rel=0.1)


@pytest.mark.parametrize("count", [100_000, 1_000_000, 10_000_000])
@pytest.mark.parametrize("growth", [1.04, 2.0])
def test_a_densification_takes_less_than_an_iteration_afterwards(
    scene: Scene, count: int, growth: float
) -> None:
    """A quarter of the growth stays, a quarter is cloned, and one is split, which makes two."""
    with training(scene, count, WIDTH, growth / 4) as (trainer, memory):
        memory.restart()
        random = generator(1, "task", "split", 1)
        densify(trainer.state, trainer.statistics, trainer.spec.config.densify, 1.0, random)
    grown = len(trainer.state.gaussians)
    assert grown == pytest.approx(count * growth, rel=0.02)
    assert memory.peak < device_memory.training(grown, 0)


def test_a_checkpoint_takes_none(scene: Scene) -> None:
    with training(scene, 1_000_000, WIDTH, 0.0) as (trainer, memory):
        memory.restart()
        before = memory.peak
        checkpoint = trainer.checkpoint()
        assert memory.peak == before
    assert all(tensor.is_cpu for tensor in checkpoint.tensors.values())


@pytest.mark.parametrize("scored", [False, True])
@pytest.mark.parametrize(("count", "width"), SIZES)
def test_a_panorama_that_is_only_rendered_or_scored(
    scene: Scene, count: int, width: int, scored: bool
) -> None:
    panorama, pixels = scene.panoramas[0], width * width // 2
    with CountedMemory(device_memory.pairs(count, pixels)) as memory:
        gaussians, seen = model(count), view(width)
        gaussians.means.requires_grad_(scored)
        memory.restart()
        if scored:
            camera = Camera.of(panorama.rotation, panorama.translation, width, width // 2)
            loss = photometric_loss(render(gaussians, camera).color, seen.image, seen.mask)
            torch.autograd.grad(loss.loss, gaussians.means)
        else:
            render_panorama(gaussians, panorama.rotation, panorama.translation, width, 0.1)
    need = (device_memory.scoring if scored else device_memory.rendering)(count, pixels)
    assert need == pytest.approx(memory.peak, rel=0.1)


@pytest.mark.parametrize(("count", "width"), SIZES)
def test_baking_takes_less_than_training_the_whole_model(count: int, width: int) -> None:
    """Half of the tiles are active, and have something in front; half of the Gaussians are among own ones."""
    pixels, camera = width * width // 2, Camera(torch.eye(3), torch.zeros(3), width, width // 2)
    with CountedMemory(device_memory.pairs(count, pixels), 0.5) as memory:
        whole = model(count)
        memory.restart()
        found = bake(whole, count // 8, camera, near=0.1, unit=1.0)
    assert found.back.is_meta and len(found.splats) == 16 * (count // 2)
    assert memory.peak < device_memory.training(count, pixels)


def test_ten_million_gaussians_fit_a_gpu_of_24_gigabytes() -> None:
    pixels = 4096 * 2048
    need = device_memory.training(10_000_000, pixels) + device_memory.CONTEXT
    assert need < 24e9
    assert device_memory.trainable(need - device_memory.CONTEXT, pixels) == pytest.approx(10_000_000)
