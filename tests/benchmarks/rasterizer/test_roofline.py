"""The model of cards: instructions are those of the PTX, counts those of the scene, times add up."""

import itertools
import json

import pytest
import torch

from benchmarks.rasterizer import roofline
from benchmarks.rasterizer.cases import CaseSpec
from benchmarks.rasterizer.iteration import TrainingStep
from benchmarks.rasterizer.roofline import CARDS, Gpu, Work, counted, launched, loops_of, seconds, work_of
from panolog.renderer.iteration import forward
from tests.renderer.cuda.emulation import EmulatedLaunch
from tests.renderer.cuda.ptx.program import kernels
from tests.renderer.cuda.stubbed import stubbed

PROGRAM = """
.visible .entry small(
.param .u64 small_param_0
)
{
.reg .f32 %f<9>;
.reg .pred %p<3>;
mov.f32 %f1, %f2;
add.f32 %f1, %f2, %f3;
$L1:
mul.f32 %f1, %f1, %f1;
$L2:
ex2.approx.f32 %f4, %f1;
st.shared.f32 [%f1], %f4;
@%p1 bra $L2;
@%p2 bra $L1;
ret;
}
"""


def test_instructions_count_as_often_as_their_innermost_loop_turns() -> None:
    (kernel,) = kernels(PROGRAM)
    assert len(loops_of(kernel)) == 2
    expected = {"add": 1, "mul": 3, "bra": 12 + 3, "ex2": 12, "st.shared": 12}
    assert counted(kernel, (3, 12)) == expected
    with pytest.raises(ValueError, match="small has 2 loops"):
        counted(kernel, (3,))


def test_a_kernel_takes_as_long_as_the_slowest_part_of_a_card() -> None:
    gpu = Gpu(sms=10, gigahertz=1.0, gigabytes=100, lanes=64)
    found = seconds(gpu, {"fma": 40, "ex2": 5, "ld.shared": 6, "setp": 9}, warps=1e6, size=2e8)
    assert found == pytest.approx(
        {
            "issue": 60e6 / 40e9,
            "floats": 40e6 / 20e9,
            "special": 5e6 / 5e9,
            "shared": 6e6 / 10e9,
            "memory": 2e-3,
        }
    )


def test_what_warps_visit_is_what_composites_in_their_pixels() -> None:
    spec = CaseSpec(64, 300)
    work, case = work_of(spec), spec.make()
    seen = forward(TrainingStep(case, case.views[0]).problem())
    entries, starts = seen.frame[3].view(-1, 3), seen.frame[4].tolist()
    visits = groups = batches = 0
    for first, last in itertools.pairwise(starts):
        deepest = 0
        for left, top in ((x, y) for y in range(0, 16, 4) for x in (0, 8)):
            blocks = [4 * (left // 4 + side) + top // 4 for side in (0, 1)]
            reached = [
                place
                for place, met in enumerate(entries[first:last, 2].tolist())
                if any(met >> b & 1 for b in blocks)
            ]
            visits += len(reached)
            groups += -(-(max(reached, default=-1) + 1) // 32)
            deepest = max(deepest, max(reached, default=-1) + 1)
        batches += -(-deepest // 256)
    assert (work.visits, work.groups, work.batches) == (visits, groups, batches) and visits > 300
    assert (work.gaussians, work.pixels, work.tiles, work.pairs) == (300, 64 * 32, 8, len(entries))


def test_the_model_knows_each_kernel_of_an_iteration_and_says_what_it_is(
    capsys: pytest.CaptureFixture[str],
) -> None:
    pytest.importorskip("cuda.core", reason="CUDA: no cuda-core")
    assert roofline.main(["--quick", "--json", "--cards", "T4,4090"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["model"] is True and set(found["total_ms"]) == {"T4", "4090"}
    work = Work(**found["work"])
    for card, times in found["kernels_ms"].items():
        assert set(times) == {*launched(work), *roofline.sorting(work)}
        assert found["total_ms"][card] == pytest.approx(sum(times.values())) and min(times.values()) > 0
    assert found["total_ms"]["4090"] < found["total_ms"]["T4"]


def test_cards_go_by_the_names_of_the_driver() -> None:
    assert roofline.card_of("NVIDIA GeForce RTX 4090") is CARDS["4090"]
    assert roofline.card_of("Tesla T4") is CARDS["T4"]
    assert roofline.card_of("NVIDIA A100-SXM4-80GB") is CARDS["A100"]
    assert roofline.card_of("NVIDIA GeForce RTX 4090 Laptop GPU") is None
    assert roofline.card_of("NVIDIA GeForce RTX 4080") is None
    assert roofline.card_of("NVIDIA GeForce RTX 3060 Ti") is None


@pytest.mark.system
def test_kernels_are_timed_one_by_one_and_compared() -> None:
    case = CaseSpec(32, 60).make()
    with stubbed(EmulatedLaunch()):
        took = roofline.measured(case, 2)
        assert roofline.baking(case, 2) > 0
    work = Work(60, 512, 2, 70, 2.0, 16.0, 99.0)
    assert set(launched(work)) - set(took) == {
        "iteration_statistics"
    }  # which is not a part of a benchmark's step
    assert min(took.values()) > 0
    table = roofline.comparison({"project_step": 2.0, "iteration_guard": 1.0}, {"project_step": 0.5})
    rows = [[cell.strip() for cell in line.split("|")[1:-1]] for line in table.splitlines()[2:]]
    assert rows[0][0] == "project_step" and float(rows[0][3]) == 25 and rows[1][2] == "–"


def test_a_clock_that_waits_gives_each_kernel_its_own_time() -> None:
    at = [0.0]

    def launch(kernel: str, grid: tuple[int, int], block: int, /, **arguments: object) -> None:
        at[0] += {"one": 2.0, "other": 3.0}[kernel]

    timed = roofline.Timed(launch, lambda: at[0])
    for kernel in ("one", "other", "one"):
        timed(kernel, (1, 1), 32, x=torch.zeros(1))
    assert timed.seconds == {"one": [2, 2], "other": [3]}
