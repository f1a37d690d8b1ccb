"""The emulation itself: what is wrong on a card is an error in it, with kernel, line, block and thread.

One probe of each kind that the sample of test_mutants.py does not have, in the kernels themselves.
"""

import re
from pathlib import Path

import pytest
import torch
from torch import Tensor

from tests.renderer.cuda.emulation import EmulatedLaunch, KernelError, has_fused_multiply_add

KERNELS = """
#include "common.cuh"
PROBE(probe_mask) { out[threadIdx.x] = __any_sync(uint32_t(n), 1); }
PROBE(probe_mixed) { out[threadIdx.x] = int(threadIdx.x) < n ? __syncthreads_or(1) : (__syncthreads(), 2); }
PROBE(probe_warp) {
  __shared__ float values[64];
  values[threadIdx.x] = float(threadIdx.x);
  n ? __syncwarp() : void(__any_sync(0xffffffffu, 1));  // a vote orders no accesses
  out[threadIdx.x] = values[threadIdx.x ^ 1];
}
PROBE(probe_blocks_read) { out[panolog::thread_of_grid()] = n ? 0 : out[64 * (1 - blockIdx.x)]; }
PROBE(probe_stack) {
  float values[4] = {1, 2, 3, 4};
  out[threadIdx.x] = values[n];
}
PROBE(probe_wide) { out[64 + threadIdx.x] = reinterpret_cast<const float4*>(out + n)->x; }
PROBE(probe_unset) {
  __shared__ float values[64];
  if (n || threadIdx.x) values[threadIdx.x] = 1;
  out[threadIdx.x] = values[threadIdx.x];
}
PROBE(probe_double) { out[threadIdx.x] = 2 * out[threadIdx.x]; }
PROBE(probe_half) { if (int(threadIdx.x) < n) out[threadIdx.x] = 1; }
PROBE(probe_turn) { out[1 + panolog::thread_of_grid()] = atomicAdd(out, 1.0f); }
PROBE(probe_rounding) {
  const float a = out[0], b = out[1];
  __syncthreads();
  if (threadIdx.x == 0) out[2] = a * a - b, out[3] = out[3] * a;
}
"""
DECLARATION = r'extern "C" __global__ void __launch_bounds__(64) \1(int64_t n, float* out)'


@pytest.fixture(params=range(3))
def launch(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> EmulatedLaunch:
    folder = tmp_path_factory.getbasetemp() / "probes"
    folder.mkdir(exist_ok=True)
    if not (folder / "probe.cu").exists():
        (folder / "probe.cu").write_text(re.sub(r"PROBE\((\w+)\)", DECLARATION, KERNELS))
    return EmulatedLaunch(folder, seed=request.param, into=folder)


# What is right, and what is not: the kernel's `n`, and what the report says.
FAULTS = {
    "mask": (0xFFFFFFFF, 0xFFFF, "__ballot_sync is not for all lanes, but for 0xffff"),
    "mixed": (64, 32, "__syncthreads(_or)? meets __syncthreads(_or)?"),
    "warp": (1, 0, "(race|uninitialised): LINE reads 4 bytes of shared values"),
    "blocks_read": (1, 0, r"race: LINE (reads|writes) 4 bytes of out .* by another block at LINE"),
    "stack": (3, 4, "out of bounds: .*probe.cu:[0-9]+ uses index 4 of an array"),
    "wide": (4, 1, "misaligned: .*probe.cu:[0-9]+ uses an address that ends with 0x.* as one of 16 bytes"),
    "unset": (1, 0, "uninitialised: LINE reads 4 bytes of shared values at byte 0"),
}


@pytest.mark.parametrize("name", FAULTS)
def test_what_a_card_would_not_report(name: str, launch: EmulatedLaunch) -> None:
    right, wrong, expected = FAULTS[name]
    grid = (1 + (name == "blocks_read"), 1)
    launch(f"probe_{name}", grid, 64, n=right, out=torch.zeros(128))
    line = r"probe\.cu:\d+"
    place = r".*\((thread \d+ of )?block \d, \d\), seed \d$"
    with pytest.raises(KernelError, match=f"^probe_{name}: {expected.replace('LINE', line)}{place}"):
        launch(f"probe_{name}", grid, 64, n=wrong, out=torch.zeros(128))


def turns(folder: Path, seed: int) -> list[float]:
    """When each thread of two blocks ran."""
    out = torch.zeros(129)
    EmulatedLaunch(folder, seed=seed, into=folder)("probe_turn", (2, 1), 64, n=0, out=out)
    return [float(turn) for turn in out[1:]]


def test_the_order_of_threads_and_blocks_depends_on_the_seed_alone(launch: EmulatedLaunch) -> None:
    orders = [turns(launch.folder, seed) for seed in range(8)]
    assert all(sorted(order) == list(range(128)) for order in orders)
    assert len(set(map(tuple, orders))) == len(orders)
    assert len({order[0] < order[64] for order in orders}) == 2
    assert turns(launch.folder, 3) == orders[3]


def test_memory_that_torch_leaves_empty(launch: EmulatedLaunch) -> None:
    with launch.watching():
        made = [torch.zeros(4).new_empty(64), torch.empty(64), torch.empty_like(torch.zeros(64))]
        for out in made:
            assert out.isnan().all()
            with pytest.raises(KernelError, match=r"uninitialised: .* reads 4 bytes of out"):
                launch("probe_double", (1, 1), 64, n=0, out=out)
        out = made[0]
        launch("probe_half", (1, 1), 64, n=63, out=out)
        launch("probe_double", (1, 1), 32, n=0, out=out)
        assert (out[:32] == 2).all() and (out[32:63] == 1).all()
        with pytest.raises(KernelError, match=r"uninitialised: .* reads 4 bytes of out at byte 252"):
            launch("probe_double", (1, 1), 64, n=0, out=out)
        launch("probe_double", (1, 1), 64, n=0, out=made[1].fill_(1))
        launch("probe_double", (1, 1), 64, n=0, out=torch.neg(torch.ones(64), out=made[2]))
    launch("probe_double", (1, 1), 64, n=0, out=out)


def rounding(launch: EmulatedLaunch) -> Tensor:
    """a·a - b where only a fused multiply-add leaves something, and a denormal."""
    a = 1 + 2.0**-12
    out = torch.tensor([a, float(torch.tensor(a) ** 2), 0, 1e-40])
    launch("probe_rounding", (1, 1), 64, n=0, out=out)
    return out[2:]


def test_rounding_as_on_a_card(launch: EmulatedLaunch, monkeypatch: pytest.MonkeyPatch) -> None:
    plain = rounding(launch)
    assert plain[0] == 0 and plain[1] > 0
    monkeypatch.setattr("tests.renderer.cuda.emulation.MODULES", {"probe": {"use_fast_math": True}})
    assert rounding(EmulatedLaunch(launch.folder, flush=True, into=launch.into)).tolist() == [0, 0]
    if has_fused_multiply_add():
        contracted = rounding(EmulatedLaunch(launch.folder, contract=True, into=launch.into))
        assert contracted[0] != 0 and contracted[1] > 0
