"""What is timed is a real training iteration that leaves the model as it was; what it launches and meets."""

import json

import pytest
import torch

from benchmarks.rasterizer.cases import CaseSpec
from benchmarks.rasterizer.iteration import TrainingStep
from tests.renderer.cuda.emulation import EmulatedLaunch
from tests.renderer.cuda.stubbed import stubbed

LAUNCHES = [
    *("project_forward", "bin_narrow", "composite_forward", "loss_similarity", "loss_gradient"),
    *("loss_absolute", "iteration_guard", "composite_backward", "project_step", "iteration_end"),
    "iteration_statistics",
]


@pytest.mark.system
@pytest.mark.parametrize("block", [None, "middle"])
def test_an_iteration_on_a_card_leaves_the_model_too(block: str | None) -> None:
    case = CaseSpec(32, 60 if block is None else 400, block=block).make()
    step, here = TrainingStep(case, case.views[0]), TrainingStep(case, case.views[0])
    here.iteration()
    with stubbed(EmulatedLaunch()):
        step.iteration()
        assert step.room is not None and step.room > 1
        step.iteration()
    moment = here.state.exp_avg["means"]
    # the second step adds 0.9 times the first to the moment
    assert (step.state.exp_avg["means"] - 1.9 * moment).norm() <= 1e-2 * moment.norm()
    for name, tensor in step.state.gaussians.tensors().items():
        assert torch.equal(tensor, getattr(case.gaussians, name)), name


def test_each_kernel_is_launched_once(capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("cuda.core", reason="needs cuda-core: pip install cuda-core")
    from benchmarks.rasterizer import launches  # noqa: PLC0415

    assert launches.main(["--quick", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["launches"] == dict.fromkeys(LAUNCHES, 1)
    assert 0 < found["fastest_ms"] <= found["median_ms"]
