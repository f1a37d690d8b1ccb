"""How instructions round, by the PTX ISA, and what is reported, in a program that has little else."""

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
