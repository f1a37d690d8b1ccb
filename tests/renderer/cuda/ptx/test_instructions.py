"""What each kind of instruction does, by the PTX ISA, in a program that has little else."""

import math
import re
from collections.abc import Callable
from pathlib import Path

import pytest
import torch

from tests.renderer.cuda.emulation import EmulatedLaunch, KernelError
from tests.renderer.cuda.ptx import EITHER, HIGHEST, LOWEST, NEAREST
from tests.renderer.cuda.ptx.program import PtxError
from tests.renderer.cuda.ptx.translation import translate

pytestmark = pytest.mark.system

TINY, HUGE = 2.0**-130, 2.0**127  # a subnormal
INF, NAN = math.inf, math.nan

ONE = "@%p2"  # in thread 0
Rows = list[tuple[float, float, float | None]]  # two operands and the result; without it a reported fault

# %r1 and %r2 have the bits of %f1 and %f2.
FLOATS: dict[str, Rows] = {
    "add.ftz.f32 %f0, %f1, %f2": [(TINY, TINY, 0.0), (1.0, 2.0, 3.0)],
    "add.f32 %f0, %f1, %f2": [(TINY, TINY, 2 * TINY)],
    "mul.ftz.f32 %f0, %f1, %f2": [(2.0**-100, -(2.0**-30), -0.0), (TINY, HUGE, 0.0)],
    "neg.ftz.f32 %f0, %f1": [(TINY, 0.0, -0.0), (2.0, 0.0, -2.0)],
    "abs.ftz.f32 %f0, %f1": [(-TINY, 0.0, 0.0), (-2.0, 0.0, 2.0)],
    "fma.rn.f32 %f0, %f1, %f1, %f2": [(1 + 2.0**-12, -1 - 2.0**-11, 2.0**-24)],
    "fma.rm.f32 %f0, %f1, %f1, %f2": [(1.0, 2.0**-30, 1.0), (1.0, -(2.0**-30), 1 - 2.0**-24)],
    "div.approx.ftz.f32 %f0, %f1, %f2": [
        *((1.0, HUGE, 0.0), (-1.0, HUGE, -0.0), (INF, HUGE, NAN), (1.0, INF, 0.0)),
        *((HUGE, 2.0**126, 2.0), (1.0, TINY, INF), (TINY, TINY, NAN), (6.0, 3.0, 2.0)),
    ],
    "div.rn.f32 %f0, %f1, %f2": [(1.0, HUGE, 2.0**-127), (1.0, 0.0, INF)],
    "rcp.approx.ftz.f32 %f0, %f1": [(-TINY, 0.0, -INF), (HUGE, 0.0, 0.0), (4.0, 0.0, 0.25)],
    "sqrt.approx.ftz.f32 %f0, %f1": [(-1.0, 0.0, NAN), (TINY, 0.0, 0.0), (4.0, 0.0, 2.0)],
    "rsqrt.approx.ftz.f32 %f0, %f1": [(TINY, 0.0, INF), (4.0, 0.0, 0.5)],
    "ex2.approx.ftz.f32 %f0, %f1": [(-130.0, 0.0, 0.0), (TINY, 0.0, 1.0), (-INF, 0.0, 0.0), (3.0, 0.0, 8.0)],
    "lg2.approx.ftz.f32 %f0, %f1": [(TINY, 0.0, -INF), (-1.0, 0.0, NAN), (8.0, 0.0, 3.0)],
    "sin.approx.ftz.f32 %f0, %f1": [(0.0, 0.0, 0.0), (INF, 0.0, None)],
    "cos.approx.ftz.f32 %f0, %f1": [(TINY, 0.0, 1.0), (400.0, 0.0, None)],
    "min.f32 %f0, %f1, %f2": [(NAN, 1.0, 1.0), (1.0, NAN, 1.0), (0.0, -0.0, -0.0), (2.0, 1.0, 1.0)],
    "max.f32 %f0, %f1, %f2": [(NAN, 1.0, 1.0), (-0.0, 0.0, 0.0), (NAN, NAN, NAN), (2.0, 1.0, 2.0)],
    f"{ONE} atom.global.add.f32 %f0, [%rd2], %f1;{ONE} atom.global.add.f32 %f0, [%rd2], %f1": [
        *((TINY, 0.0, 0.0), (2.0, 0.0, 2.0)),
    ],
    "copysign.f32 %f0, %f1, %f2": [(-1.0, 2.0, -2.0), (1.0, -2.0, 2.0)],
    "cvt.rni.f32.f32 %f0, %f1": [(2.5, 0.0, 2.0), (-0.5, 0.0, -0.0)],
    "cvt.rmi.f32.f32 %f0, %f1": [(-2.5, 0.0, -3.0)],
    "cvt.rpi.f32.f32 %f0, %f1": [(-2.5, 0.0, -2.0)],
    "cvt.sat.f32.f32 %f0, %f1": [(NAN, 0.0, 0.0), (2.0, 0.0, 1.0), (-1.0, 0.0, 0.0), (0.5, 0.0, 0.5)],
}
INTEGERS: dict[str, Rows] = {
    "cvt.rzi.s32.f32 %r0, %f1": [
        (-2.5, 0.0, -2),
        (3e9, 0.0, 2**31 - 1),
        (-3e9, 0.0, -(2**31)),
        (NAN, 0.0, 0),
    ],
    "cvt.rni.s32.f32 %r0, %f1": [(2.5, 0.0, 2), (3.5, 0.0, 4)],
    "cvt.rzi.u32.f32 %r0, %f1": [(-1.0, 0.0, 0), (3e9, 0.0, 3_000_000_000 - 2**32), (INF, 0.0, -1)],
    "add.s32 %r0, %r1, %r2": [(2**31 - 1, 1, -(2**31))],
    "mul.hi.s32 %r0, %r1, %r2": [(-1, 1, -1), (2**30, 8, 2)],
    "mad.lo.s32 %r0, %r1, %r2, %r1": [(3, 5, 18)],
    "shl.b32 %r0, %r1, %r2": [(1, 31, -(2**31)), (1, 32, 0)],
    "shr.s32 %r0, %r1, %r2": [(-8, 1, -4), (-8, 40, -1)],
    "shr.u32 %r0, %r1, %r2": [(-8, 28, 15), (-8, 32, 0)],
    "div.s32 %r0, %r1, %r2": [(-7, 2, -3), (-(2**31), -1, -(2**31))],
    "min.u32 %r0, %r1, %r2": [(-1, 1, 1)],
    "popc.b32 %r0, %r1": [(-1, 0, 32), (5, 0, 2)],
    "brev.b32 %r0, %r1": [(1, 0, -(2**31))],
    "bfind.shiftamt.u32 %r0, %r1": [(1, 0, 31), (0, 0, -1)],
    "bfi.b32 %r0, %r1, %r2, 4, 8": [(0xFF, 0, 0xFF0), (0, -1, -0xFF1)],
    "setp.ltu.f32 %p1, %f1, %f2;selp.b32 %r0, 1, 0, %p1": [(NAN, 1.0, 1), (1.0, 1.0, 0)],
    "setp.lt.f32 %p1, %f1, %f2;selp.b32 %r0, 1, 0, %p1": [(NAN, 1.0, 0), (0.5, 1.0, 1)],
    "setp.ne.f32 %p1, %f1, %f2;selp.b32 %r0, 1, 0, %p1": [(NAN, 1.0, 0), (0.5, 1.0, 1)],
    "setp.neu.f32 %p1, %f1, %f2;selp.b32 %r0, 1, 0, %p1": [(NAN, 1.0, 1), (1.0, 1.0, 0)],
    "setp.equ.f32 %p1, %f1, %f2;selp.b32 %r0, 1, 0, %p1": [(NAN, 1.0, 1), (0.5, 1.0, 0)],
    "setp.nan.f32 %p1, %f1, %f2;selp.b32 %r0, 1, 0, %p1": [(1.0, NAN, 1), (0.5, 1.0, 0)],
    "setp.leu.ftz.f32 %p1, %f1, %f2;selp.b32 %r0, 1, 0, %p1": [(TINY, 0.0, 1), (1.0, 0.0, 0)],
    "setp.leu.f32 %p1, %f1, %f2;selp.b32 %r0, 1, 0, %p1": [(TINY, 0.0, 0)],
    "shfl.sync.bfly.b32 %r0|%p1, %r7, 5, 31, -1": [(0, 0, 5)],
    "shfl.sync.down.b32 %r0|%p1, %r7, 16, 31, -1": [(0, 0, 16)],
    "shfl.sync.idx.b32 %r0|%p1, %r7, 7, 31, -1": [(0, 0, 7)],
    "shfl.sync.up.b32 %r0|%p1, %r7, 1, 0, -1": [(0, 0, 0)],
    "vote.sync.ballot.b32 %r0, %p2, -1": [(0, 0, 1)],
    "vote.sync.any.pred %p1, %p2, -1;selp.b32 %r0, 1, 0, %p1": [(0, 0, 1)],
    "vote.sync.all.pred %p1, %p2, -1;selp.b32 %r0, 1, 0, %p1": [(0, 0, 0)],
    "bar.red.or.pred %p1, 0, !%p2;selp.b32 %r0, 1, 0, %p1": [(0, 0, 1)],
    f"{ONE} atom.global.or.b32 %r0, [%rd2], 6;{ONE} atom.global.or.b32 %r0, [%rd2], 1": [(0, 0, 6)],
}
# What each approximates, and how far off it may be: for sine, cosine and logarithms near 0 not as a share.
APPROXIMATIONS: dict[str, tuple[Callable[[float, float], float], float]] = {
    "rcp.approx.ftz.f32 %f0, %f1": (lambda a, _: 1 / a, 2.0**-23),
    "div.approx.ftz.f32 %f0, %f2, %f1": (lambda a, b: b / a, 2.0**-22),
    "sqrt.approx.ftz.f32 %f0, %f1": (lambda a, _: math.sqrt(a), 2.0**-23),
    "rsqrt.approx.ftz.f32 %f0, %f1": (lambda a, _: 1 / math.sqrt(a), 2.0**-22.9),
    "ex2.approx.ftz.f32 %f0, %f1": (lambda a, _: 2.0**a, 2.0**-22),
    "lg2.approx.ftz.f32 %f0, %f1": (lambda a, _: math.log2(a), 2.0**-22),
    "sin.approx.ftz.f32 %f0, %f1": (lambda a, _: math.sin(a), 2.0**-20.5),
    "cos.approx.ftz.f32 %f0, %f1": (lambda a, _: math.cos(a), 2.0**-20.5),
}
PROBE = """
.visible .entry probe_{number}(
	.param .u64 .ptr .align 1 probe_{number}_param_0,
	.param .u64 .ptr .align 1 probe_{number}_param_1
)
.maxntid 32
{{
	.reg .pred 	%p<3>;
	.reg .b32 	%r<9>;
	.reg .f32 	%f<9>;
	.reg .b64 	%rd<9>;
	ld.param.u64 	%rd1, [probe_{number}_param_0];
	ld.param.u64 	%rd2, [probe_{number}_param_1];
	mov.u32 	%r7, %tid.x;
	setp.eq.s32 	%p2, %r7, 0;
	ld.global.v2.f32 	{{%f1, %f2}}, [%rd1];
	mov.b32 	%r1, %f1;
	mov.b32 	%r2, %f2;
	{body}
	@!%p2 bra 	$L__BB{number}_1;
	{store};
$L__BB{number}_1:
	ret;
}}
"""
SOURCE = 'extern "C" __global__ void __launch_bounds__(32) probe_{}(const float* given, float* out);'


def launch(folder: Path, instructions: list[str], error: int = NEAREST) -> EmulatedLaunch:
    """Kernels probe_0 and so on, which differ in one instruction."""
    probes, sources = [], []
    for number, text in enumerate(instructions):
        body = "\n\t".join(f"{line};" for line in text.split(";"))
        store = f"st.global.{'f32 [%rd2], %f0' if re.search('%f0', text) else 'u32 [%rd2], %r0'}"
        probes.append(PROBE.format(number=number, body=body, store=store))
        sources.append(SOURCE.format(number))
    (folder / "probe.cu").write_text(translate("".join(probes), "\n".join(sources), "probe.ptx", error))
    return EmulatedLaunch(folder, into=folder, instrument=False)


def bits(values: tuple[float, ...]) -> torch.Tensor:
    """Floats as they are, integers as the floats with their bits."""
    parts = [torch.tensor(value, dtype=torch.int32) for value in values if isinstance(value, int)]
    if parts:
        return torch.stack(parts).view(torch.float32)
    return torch.tensor(values)


def test_what_instructions_compute(tmp_path: Path) -> None:
    cases = FLOATS | INTEGERS
    run = launch(tmp_path, list(cases))
    for number, (text, rows) in enumerate(cases.items()):
        for a, b, expected in rows:
            out = torch.zeros(1)
            given = {"given": bits((a, b)), "out": out}
            if expected is None:
                with pytest.raises(KernelError, match="no error is documented"):
                    run(f"probe_{number}", (1, 1), 32, **given)
                continue
            run(f"probe_{number}", (1, 1), 32, **given)
            wanted = bits((expected,))
            same = torch.equal(out.view(torch.int32), wanted.view(torch.int32))
            assert same or (out.isnan().all() and wanted.isnan().all()), (text, a, b, out.item())


@pytest.mark.parametrize("error", [NEAREST, HIGHEST, LOWEST, EITHER])
def test_approximate_results_reach_their_documented_error(error: int, tmp_path: Path) -> None:
    run = launch(tmp_path, list(APPROXIMATIONS), error)
    for number, (text, (exact, bound)) in enumerate(APPROXIMATIONS.items()):
        errors = []
        for step in range(40):
            given = torch.tensor([0.7 + step / 7, 1.9])
            out = torch.zeros(1)
            run(f"probe_{number}", (1, 1), 32, given=given, out=out)
            value = exact(*map(float, given))
            a = float(given[0])
            absolute = text.startswith(("sin", "cos")) or (text.startswith("lg2") and 0.5 < a < 2)
            errors.append((float(out) - value) / (1 if absolute else abs(value)) / bound)
        most = max(map(abs, errors))
        assert most <= 1.0, text
        assert (most > 0.6) == (error != NEAREST), (text, most)
        assert min(errors) < 0 or error == HIGHEST, text
        assert max(errors) > 0 or error == LOWEST, text


@pytest.mark.parametrize(
    ("instruction", "message"),
    [
        ("tanh.approx.f32 %f0, %f1", "probe_0, line .*: tanh.approx.f32 %f0, %f1: unknown instruction"),
        ("add.rz.f32 %f0, %f1, %f2", "unknown instruction"),
        ("ld.global.nc.f32 %f0, [%rd1]", "unknown modifier"),
        ("shfl.sync.bfly.b64 %r0|%p1, %r7, 5, 31, -1", "unknown modifier"),
        ("bar.sync 1", "another barrier than 0"),
        ("add.f32 %f0, %f1", "3 operands expected"),
        ("add.f32 %f0, %f1, constant", "operand constant"),
        ("mov.u32 %r0, %clock", "%clock is not declared"),
        ("ld.global.v4.f32 {%f0, %f1}, [%rd1]", "a vector of 4 expected"),
        ("call.uni (%r0), function, (%r1)", r"probe_0, line|unknown instruction"),
    ],
)
def test_what_is_unknown_is_an_error(instruction: str, message: str, tmp_path: Path) -> None:
    with pytest.raises(PtxError, match=message):
        launch(tmp_path, [instruction])


@pytest.mark.parametrize(
    ("instruction", "message"),
    [
        ("ld.global.f32 %f0, [%rd1+8]", "out of bounds: probe.ptx:19 reads 4 bytes at byte 8 of"),
        ("ld.global.f32 %f0, [%rd1+2]", "misaligned: probe.ptx:19 reads 4 bytes of given at byte 2"),
        ("ld.global.v8.f32 {%f0, %f1, %f2, %f3, %f4, %f5, %f6, %f7}, [%rd1+16]", "misaligned|out of bounds"),
        ("ld.param.u32 %r0, [probe_0_param_1+8]", "4 bytes are in no local variable or parameter"),
        ("ld.shared.f32 %f0, [%r1]", "is no address in shared memory"),
        ("vote.sync.any.pred %p1, %p2, 1;mov.u32 %r0, 0", "not for all lanes"),
        ("@%p2 bar.sync 0;mov.u32 %r0, 0", "threads wait for others that never come"),
        ("$L__BB0_2:\n\tbra $L__BB0_2;mov.u32 %r0, 0", "a loop does not end"),
    ],
)
def test_what_is_wrong_is_reported(instruction: str, message: str, tmp_path: Path) -> None:
    run = launch(tmp_path, [instruction])
    with pytest.raises(KernelError, match=message):
        run("probe_0", (1, 1), 32, given=torch.zeros(2), out=torch.zeros(1))
