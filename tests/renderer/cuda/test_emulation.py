"""The emulation itself: what is wrong on a card is an error in it."""

from pathlib import Path

import pytest
import torch

from tests.renderer.cuda.emulation import EmulatedLaunch

KERNELS = """
#include "common.cuh"
extern "C" __global__ void __launch_bounds__(64) probe_barrier(int64_t late, float* out) {
  if (int(threadIdx.x) >= late) return;
  __syncthreads();
  out[threadIdx.x] = 1;
}
extern "C" __global__ void __launch_bounds__(64) probe_lanes(int64_t half, float* out) {
  if (int(threadIdx.x) % 32 < half) out[threadIdx.x] = __any_sync(0xffffffffu, 1);
}
extern "C" __global__ void __launch_bounds__(64) probe_order(int64_t careful, float* out) {
  __shared__ float values[64];
  values[threadIdx.x] = float(threadIdx.x);
  if (careful) __syncthreads();
  out[threadIdx.x] = values[63 - threadIdx.x];
}
extern "C" __global__ void __launch_bounds__(64) probe_lane_sums(int64_t unused, float* out) {
  float sum = float(threadIdx.x);
  for (int step = 16; step; step /= 2) sum += __shfl_xor_sync(0xffffffffu, sum, step);
  out[threadIdx.x] = sum;
}
"""


@pytest.fixture(params=[False, True], ids=["forwards", "backwards"])
def launch(request: pytest.FixtureRequest, tmp_path: Path) -> EmulatedLaunch:
    (tmp_path / "probe.cu").write_text(KERNELS)
    return EmulatedLaunch(tmp_path, backwards=request.param)


def test_a_barrier_that_some_threads_never_reach(launch: EmulatedLaunch) -> None:
    out = torch.zeros(64)
    launch("probe_barrier", (1, 1), 64, late=64, out=out)
    assert out.all()
    with pytest.raises(AssertionError, match="never come"):
        launch("probe_barrier", (1, 1), 64, late=40, out=out)


def test_a_warp_operation_that_some_lanes_never_reach(launch: EmulatedLaunch) -> None:
    out = torch.zeros(64)
    launch("probe_lanes", (1, 1), 64, half=32, out=out)
    assert out.all()
    with pytest.raises(AssertionError, match="never come"):
        launch("probe_lanes", (1, 1), 64, half=16, out=out)


def test_a_missing_barrier_shows_as_nan(launch: EmulatedLaunch) -> None:
    out = torch.zeros(64)
    launch("probe_order", (1, 1), 64, careful=1, out=out)
    assert out.tolist() == list(range(63, -1, -1))
    launch("probe_order", (1, 1), 64, careful=0, out=out)
    assert out.isnan().any()


def test_shuffles(launch: EmulatedLaunch) -> None:
    out = torch.zeros(64)
    launch("probe_lane_sums", (1, 1), 64, unused=0, out=out)
    assert out.tolist() == [sum(range(32))] * 32 + [sum(range(32, 64))] * 32


def test_arguments_that_the_kernel_does_not_take(launch: EmulatedLaunch) -> None:
    with pytest.raises(AssertionError, match="the kernel takes ip"):
        launch("probe_barrier", (1, 1), 64, late=1.0, out=torch.zeros(64))
    with pytest.raises(TypeError, match="probe_barrier takes late, out, not early, out"):
        launch("probe_barrier", (1, 1), 64, early=1, out=torch.zeros(64))
