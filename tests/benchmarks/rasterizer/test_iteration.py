"""What is timed is a real training iteration: it leaves the model as it was and launches each kernel once."""

import time

import pytest
import torch

from benchmarks.rasterizer.cases import CaseSpec
from benchmarks.rasterizer.iteration import TrainingStep
from benchmarks.rasterizer.roofline import Timed
from tests.renderer.cuda.emulation import EmulatedLaunch
from tests.renderer.cuda.stubbed import stubbed

LAUNCHES = [
    *("project_forward", "bin_narrow", "composite_forward", "loss_similarity", "loss_gradient"),
    *("iteration_guard", "composite_backward", "project_step", "iteration_end"),
]


@pytest.mark.system
@pytest.mark.parametrize("block", [None, "middle"])
def test_an_iteration_on_a_card_leaves_the_model_too(block: str | None) -> None:
    case = CaseSpec(32, 60 if block is None else 400, block=block).make()
    step, here = TrainingStep(case, case.views[0]), TrainingStep(case, case.views[0])
    here.iteration()
    timed = Timed(EmulatedLaunch(), time.perf_counter)
    with stubbed(timed):
        step.iteration()
        assert step.room is not None and step.room > 1
        timed.seconds.clear()
        step.iteration()
    kernels = LAUNCHES if block is None else [*LAUNCHES, "project_exterior"]
    assert {kernel: len(took) for kernel, took in timed.seconds.items()} == dict.fromkeys(kernels, 1)
    moment = here.state.exp_avg["means"]
    # the second step adds 0.9 times the first to the moment
    assert (step.state.exp_avg["means"] - 1.9 * moment).norm() <= 1e-2 * moment.norm()
    for name, tensor in step.state.gaussians.tensors().items():
        assert torch.equal(tensor, getattr(case.gaussians, name)), name
