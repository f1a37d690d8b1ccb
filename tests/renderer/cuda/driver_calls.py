"""A process of test_driver.py: launches every kernel on the driver of libcuda.cpp and checks what it copies.

    python -m tests.renderer.cuda.driver_calls ARCH SIZES

SIZES: the bytes of each parameter of each kernel. Prints the names of the kernels that were launched.
"""

import ast
import ctypes
import itertools
import struct
import sys
from dataclasses import dataclass, field, replace
from unittest import mock

import torch
from torch import Tensor

from panolog.renderer.adam import Moving
from panolog.renderer.cuda import iteration, launches, nvrtc, parts
from panolog.renderer.cuda.card import Kernels
from panolog.renderer.cuda.iteration import Problem
from panolog.renderer.cuda.parts import Argument
from tests.renderer.cuda.machine import arguments, results, surrounded, to_bake
from tests.renderer.hard_scenes import camera, cloud

STREAM = 0x5EED
Pointer = ctypes.POINTER
LAUNCHED = ctypes.CFUNCTYPE(
    ctypes.c_int,
    ctypes.c_char_p,
    Pointer(ctypes.c_uint),
    Pointer(ctypes.c_uint),
    ctypes.c_size_t,
    Pointer(ctypes.c_void_p),
)


@dataclass
class Checked:
    """A `Launch` that compares what the driver received with its arguments."""

    kernels: Kernels
    sizes: dict[str, list[int]]
    launched: list[str] = field(default_factory=list)
    received: tuple[object, ...] = ()
    copied: list[bytes] = field(default_factory=list)

    def receive(self, name: bytes, grid: object, block: object, stream: int, parameters: object) -> int:
        """What libcuda.cpp calls."""
        kernel = name.decode()
        self.received = (kernel, grid[0:3], block[0:3], stream)  # type: ignore[index]
        self.copied = [
            ctypes.string_at(parameters[i], size)  # type: ignore[index]
            for i, size in enumerate(self.sizes[kernel])
        ]
        return 0

    def __call__(self, kernel: str, grid: tuple[int, int], block: int, /, **arguments: Argument) -> None:
        for tensor in arguments.values():
            if isinstance(tensor, Tensor):
                tensor.zero_()  # no kernel runs: no tile is met
        self.received = ()
        self.kernels.launch(STREAM, kernel, grid, block, arguments)
        assert [*self.received] == [kernel, [*grid, 1], [block, 1, 1], STREAM], self.received
        module = nvrtc.module_of(kernel)
        ordered = nvrtc.in_order(nvrtc.CSRC / "cuda" / f"{module}.cu", kernel, arguments)
        assert self.copied == [expected(argument) for argument in ordered], kernel
        self.launched.append(kernel)


def expected(argument: Argument) -> bytes:
    """What the kernel should find as a parameter."""
    match argument:
        case Tensor():
            return struct.pack("=Q", argument.data_ptr())
        case None:
            return bytes(8)
        case bytes():
            return argument
        case float():
            return struct.pack("=f", argument)
        case _:
            return struct.pack("=q", argument)


def every_kernel(launch: Checked) -> None:
    """Both projections: with and without mask, depth and exterior, tiles as int16 and int32; baking."""
    at, scene = camera(), cloud(40)
    image = torch.zeros(at.height, at.width, 3, dtype=torch.uint8)
    mask, depth = torch.ones(at.height, at.width, dtype=torch.bool), torch.zeros(at.height, at.width)
    status, some = iteration.Status(torch.device("cpu")), {"means": scene.means, "scales": scene.scales}
    moments = [torch.zeros_like(scene.means) for _ in range(2)]
    own = torch.arange(20)
    around = [surrounded(replace(scene, exact=exact), at, own)[1] for exact in (False, True)]
    variants = ((None, True, 0), (50, False, 9999), (60, True, 0), (70, True, 9999))
    for (room, full, narrow), exact in itertools.product(variants, (False, True)):
        absolute = full and not exact
        problem = Problem(
            model=scene.tensors(),
            camera=at,
            image=image,
            mask=mask if full else None,
            depth=(depth, mask) if full else None,
            depth_weight=0.25,
            lambda_ssim=0.2,
            rows=None,
            sh_degree=3,
            near=0.02,
            exact=exact,
            share=torch.ones((), dtype=torch.float64) if full else None,
            depth_share=torch.ones((), dtype=torch.float64) if full else None,
            exterior=around[exact] if full else None,
            moving=full,
            absolute=absolute,
            exposure=torch.ones(2, 3) if full else None,
        )
        moving = (
            {name: Moving(it, moments[0], moments[1], 30, 0.125) for name, it in some.items()} if full else {}
        )
        with mock.patch.object(parts, "NARROW_TILES", narrow):
            found = iteration.take(launch, problem, moving, 3, status, room)
        into, more = [torch.zeros(30), torch.zeros(30)], torch.zeros(30) if absolute else None
        iteration.add_statistics(launch, found, status, problem, *into, absolute=more, angle=full)
    launches.absolute_difference(launch, depth, depth, mask)
    for exact in (False, True):
        launches.bake(launch, **to_bake(replace(scene, exact=exact), at, 20))
    for columns in (2, 4):  # without and with absolute gradients
        for exact in (False, True)[: 4 // columns]:
            given = arguments(replace(scene, exact=exact), at) | {"screen": torch.zeros(40, columns)}
            made = launches.rasterize(launch, **given)
            launches.rasterize_backward(launch, **given, **results(made, list(made[:3])))


def main() -> None:
    """The program."""
    arch, sizes = sys.argv[1], ast.literal_eval(sys.argv[2])
    launch = Checked(Kernels(arch), sizes)
    function = LAUNCHED(launch.receive)
    ctypes.CDLL("libcuda.so.1").on_launch(function)
    every_kernel(launch)
    print(*sorted(set(launch.launched)))


if __name__ == "__main__":
    main()
