"""What the CUDA kernels take of a card, on every supported architecture: compiled by NVRTC."""

import re

import pytest

from panolog.renderer.cuda import nvrtc
from tests.renderer.cuda.resources import ARCHITECTURES, Kernel, compiled, measure

pytestmark = pytest.mark.system

pytest.importorskip("cuda.core", reason="CUDA: no cuda-core")

# Of a thread. An SM has 65,536, given out in groups of eight for each thread: with 48 it holds five blocks of
# 256 threads, with 64 four (all that sm_75 can hold); with 96 five blocks of 128, with 104 to 128 four.
LIMITS = {
    32: "loss_absolute iteration_statistics",
    40: "project_exterior iteration_guard iteration_end",
    48: "composite_forward composite_backward composite_absolute_backward composite_weights",
    64: "project_ray_exterior project_motion bin_narrow bin_wide bin_ray_narrow bin_ray_wide"
    " composite_ray_forward composite_ray_backward composite_ray_weights loss_similarity loss_gradient",
    96: "project_forward project_ray_forward",
    120: "project_backward project_absolute_backward project_ray_backward"
    " project_step project_absolute_step project_ray_step",
}
REGISTERS = {name: limit for limit, names in LIMITS.items() for name in names.split()}
SHARED = 48 << 10  # bytes of a block that need no opt-in
LAST_SUM = 12  # instructions in double precision: loads, additions and the store of the sum over a block
DOUBLES = ("iteration_guard", "iteration_end", "project_motion")  # otherwise: they write the report
STACK = 128  # bytes of a thread: arrays of projection with indices that are not constants; no spills
ARCH = "sm_89"
EVERY_ARCH = [
    arch if arch == ARCH else pytest.param(arch, marks=pytest.mark.nightly) for arch in ARCHITECTURES
]


@pytest.fixture(scope="module", params=EVERY_ARCH)
def kernels(request: pytest.FixtureRequest) -> list[Kernel]:
    return [kernel for module in nvrtc.MODULES for kernel in measure(module, request.param)]


def test_kernels_stay_within_their_limits(kernels: list[Kernel]) -> None:
    assert {kernel.name for kernel in kernels} == REGISTERS.keys()
    for kernel in kernels:
        assert kernel.spills == 0, kernel
        assert kernel.registers <= REGISTERS[kernel.name], kernel
        assert kernel.shared < SHARED, kernel
        assert kernel.stack <= (STACK if kernel.name.startswith("project_") else 0), kernel


def test_double_precision_is_for_the_loss_only(kernels: list[Kernel]) -> None:
    for kernel in kernels:
        if kernel.name.startswith("loss_"):
            sums = 2 if kernel.name == "loss_similarity" else 1  # also for the exposure
            assert kernel.doubles <= sums * LAST_SUM, kernel
        else:
            assert bool(kernel.doubles) == (kernel.name in DOUBLES), kernel


TWO_PI = "0f40C90FDB"  # in PTX
INSTRUCTION = re.compile(r"^\s*(?:@!?%p\d+ )?([a-z][\w.]*)\s+(.*);", re.MULTILINE)


def comparisons(ptx: str) -> set[str]:
    """What a kernel compares in single precision, as expressions of what it has loaded and accumulated.

    A product whose sum ptxas may round together with it is a `loose` one.
    """
    made: dict[str, list[tuple[str, list[str]]]] = {}
    compared = []
    for operation, text in INSTRUCTION.findall(ptx):
        names = re.findall(r"%\w+|0f\w+|\[.*?\]", text)
        if operation.startswith("ld.") and "{" in text:
            *targets, address = names
            for i, target in enumerate(targets):
                made.setdefault(target, []).append((f"{operation}{address}.{i}", []))
        elif operation.startswith("setp.") and operation.endswith(".f32"):
            compared.append(names[1:])
        elif names:
            made.setdefault(names[0], []).append((operation, names[1:]))

    def expression(name: str) -> str:
        (operation, given), *others = made.get(name, [(name, [])])
        if others:
            return "accumulated"
        inner = [expression(each) for each in given] if operation.endswith(".f32") else []
        if operation.startswith(("add.", "sub.")):
            inner = [f"loose {each}" if each.startswith("mul.") else each for each in inner]
        return f"{operation}({', '.join(inner)})"

    return {re.sub(r"%\w+", "", " against ".join(map(expression, pair))) for pair in compared}


@pytest.mark.parametrize(("kernels", "least"), [("composite", 3), ("composite_ray", 2)])
@pytest.mark.parametrize("arch", EVERY_ARCH)
def test_forward_and_backward_count_the_same_pairs(arch: str, kernels: str, least: int) -> None:
    """To the bit: each comparison of the forward pass is also one of the backward pass."""
    ptx = compiled("composite", arch).ptx
    forward, backward = (comparisons(ptx[f"{kernels}_{name}"]) for name in ("forward", "backward"))
    assert forward <= backward
    # whether a ray's footprint may reach a patch depends on its size in radians, with room for rounding
    forward = {each for each in forward if TWO_PI not in each}
    # which splats reach a patch; which count at a pixel, where a tile sees two images of one and where none
    counting = [each for each in forward if "ld.shared" in each]
    assert len(counting) >= least
    # the image of a splat; what it is compared with is exact
    image = [left for left, _, _ in (each.partition(" against ") for each in forward) if "cvt.rni" in left]
    assert not any("loose" in each for each in (*counting, *image))
