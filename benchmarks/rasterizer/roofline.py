"""A model of a training iteration on cards that are not here: milliseconds of each kernel, not measured.

    python -m benchmarks.rasterizer.roofline [--width 2048] [--gaussians 1000000] [--json]

NVRTC's PTX says how many instructions each loop of a kernel has (`tests/renderer/cuda/ptx`), the CPU's
forward pass of a random street how often warps of a card go through them. A kernel takes as long as the
slowest of these: issuing, the lanes for floats, special functions, shared memory with shuffles, and the bytes
of its arrays. All run at their peak, so a card takes longer, most of all where atomic sums meet in one place
or a kernel is short; sorting is torch's, of which only bytes are counted.
"""

import math
import re
import sys
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass
from statistics import median
from unittest import mock

import torch

from benchmarks import report
from benchmarks.rasterizer.cases import Case, CaseSpec
from benchmarks.rasterizer.iteration import TrainingStep
from panolog.renderer import ops
from panolog.renderer.baked import bake
from panolog.renderer.cuda.parts import Argument, Launch
from panolog.renderer.iteration import forward
from tests.renderer.cuda.ptx import ptx_of
from tests.renderer.cuda.ptx.program import Instruction, Kernel, kernels

ARCH = "sm_89"  # whose PTX counts for all cards: others unroll some loops otherwise
WARP, TILE_WARPS, BATCH = 32, 8, 256  # threads; warps of a tile; splats that pass shared memory at once
FREE = {"mov", "cvta", "ret", "bar"}  # registers are renamed; addresses need no conversion
SPECIAL = {"ex2", "lg2", "rcp", "rsqrt", "sqrt", "div", "sin", "cos"}
FLOATS = {
    "fma",
    "add",
    "sub",
    "mul",
    "min",
    "max",
    "abs",
    "neg",
}  # their integers are as fast, if not on a T4
EXCHANGES = {"ld.shared", "st.shared", "shfl", "vote"}


@dataclass(frozen=True)
class Gpu:
    """The peaks of a card, from NVIDIA's data sheets: boost clock, and whitepapers of its architecture."""

    sms: int
    gigahertz: float
    gigabytes: float  # of memory in a second
    lanes: int  # of an SM for floats; 16 for special functions and 32 for shared memory in all of them


CARDS = {
    "T4": Gpu(40, 1.59, 320, 64),
    "3060": Gpu(28, 1.777, 360, 128),
    "4090": Gpu(128, 2.52, 1008, 128),
    "5090": Gpu(170, 2.407, 1792, 128),
    "A100": Gpu(108, 1.41, 1555, 64),
    "H100": Gpu(132, 1.83, 3350, 128),
}


@dataclass(frozen=True)
class Work:
    """What an iteration has to do, counted on the CPU."""

    gaussians: int
    pixels: int
    tiles: int
    pairs: int  # of a splat and a tile
    batches: float  # of splats that pass shared memory, in all tiles
    groups: float  # of 32 splats that a warp tests, in all warps
    visits: float  # of a warp to a splat that reaches one of its pixels


@dataclass(frozen=True)
class Launched:
    """A kernel of the iteration: its module, warps, turns of its loops in the order of the PTX, and bytes."""

    module: str
    warps: float
    turns: tuple[float, ...]  # of each loop, by a warp in all
    bytes: float


def work_of(spec: CaseSpec) -> Work:
    """The counts of a case."""
    case = spec.make()
    step = TrainingStep(case, case.views[0])
    seen = forward(step.problem())
    entries, tiles = seen.frame[3].view(-1, 3), seen.frame[4].long()
    met, count = entries[:, 2], len(tiles) - 1
    tile = torch.repeat_interleave(torch.arange(count), tiles.diff())
    place = torch.arange(len(met)) - tiles[tile]  # in the list of its tile
    visits, groups, deepest = 0.0, 0.0, torch.zeros(count, dtype=torch.int64)
    for warp in range(TILE_WARPS):  # 8 × 4 pixels: two blocks of 4 × 4, whose bits go down the columns
        first = 8 * (warp % 2) + warp // 2
        mine = (met >> first | met >> first + 4) & 1 > 0
        last = torch.zeros(count, dtype=torch.int64).scatter_reduce(0, tile[mine], place[mine] + 1, "amax")
        visits += float(mine.sum())
        groups += float((last / WARP).ceil().sum())
        deepest = torch.maximum(deepest, last)
    pixels = seen.alpha.numel()
    batches = float((deepest / BATCH).ceil().sum())
    return Work(len(seen.state), pixels, count, len(met), batches, groups, visits)


def launched(work: Work) -> dict[str, Launched]:
    """The kernels of an iteration with affine projection and spherical harmonics of degree 3, without depth.

    Loops over 45 coefficients are unrolled by four; a splat meets two rows of tiles. Turns of loops that only
    masks, narrow images or hidden Gaussians need are 0; so are those of a tile at the seam.
    """
    n, px, warps = work.gaussians, work.pixels, work.tiles * TILE_WARPS
    each = n / WARP
    copy, colors = (1.0, 11.0), (3.0, 3.0, 3.0)
    halo = (9.0, 0.0, 0.0, 0.0)  # three turns for each of three channels
    tested = (work.batches * TILE_WARPS / warps, 0.0, 0.0, work.groups / warps, work.visits / warps)
    lists = 4.0 * work.pairs + 64 * work.pairs
    return {
        "project_forward": Launched("project", each, (*copy, 11, 1, *colors, 2), n * (244 + 73)),
        "bin_narrow": Launched("bin", n / 4, (2, 0, 1), n * 84 + 6 * work.pairs),
        "composite_forward": Launched("composite", warps, tested, lists + 20 * px),
        "loss_similarity": Launched("loss", warps, (*[0.0] * 5, 3, *halo, *[0.0] * 4, 6), 51 * px),
        "loss_gradient": Launched("loss", warps, (*[0.0] * 9, 3, 6, 6, 6), 63 * px),
        "composite_backward": Launched("composite", warps, tested, lists + 40 * px + 80 * n),
        "project_step": Launched(
            "project", each, (*copy, 3, 3, 11, 1, 0, 0, *copy), n * (116 + 59 * 24 + 180)
        ),
        "iteration_statistics": Launched("iteration", each, (), n * 45),
    }


def sorting(work: Work) -> dict[str, float]:
    """Bytes of what torch does between kernels: radix sorts of eight bits with indices of eight bytes."""
    return {
        "sort by depth": work.gaussians * (4 * 2 * (4 + 8) + 32.0),
        "sort by tile": work.pairs * (2 * 2 * (2 + 8) + 16.0),
    }


def loops_of(kernel: Kernel) -> list[tuple[int, int]]:
    """First and last place of each loop in the body, in order: what a branch goes back over."""
    labels = {line: place for place, line in enumerate(kernel.body) if isinstance(line, str)}
    back = {}
    for place, line in enumerate(kernel.body):
        if isinstance(line, Instruction) and line.opcode.startswith("bra"):
            target = labels[line.operands[-1]]
            if target < place:
                back[target] = place
    return sorted(back.items())


def kind_of(opcode: str) -> str:
    """What an instruction is: its name, of loads and stores with the memory."""
    name, *rest = opcode.split(".")
    return f"{name}.{rest[0]}" if name in ("ld", "st", "atom", "red") else name


def counted(kernel: Kernel, turns: tuple[float, ...]) -> dict[str, float]:
    """Instructions of a warp, by kind. Raises ValueError if the kernel has other loops than the model."""
    loops = loops_of(kernel)
    if len(loops) != len(turns):
        raise ValueError(f"{kernel.name} has {len(loops)} loops at {loops}, the model {len(turns)}")
    found: defaultdict[str, float] = defaultdict(float)
    for place, line in enumerate(kernel.body):
        if isinstance(line, Instruction) and (kind := kind_of(line.opcode)) not in FREE | {"ld.param"}:
            inner = [turn for (first, last), turn in zip(loops, turns, strict=True) if first <= place <= last]
            found[kind] += inner[-1] if inner else 1  # the innermost begins last
    return found


def seconds(gpu: Gpu, kinds: Mapping[str, float], warps: float, size: float) -> dict[str, float]:
    """How long each part of a card would be busy with a kernel."""

    def of(names: set[str]) -> float:
        return warps * sum(number for kind, number in kinds.items() if kind in names)

    clock = gpu.sms * gpu.gigahertz * 1e9
    return {
        "issue": of(set(kinds)) / (4 * clock),
        "floats": of(FLOATS) * WARP / (gpu.lanes * clock),
        "special": of(SPECIAL) * WARP / (16 * clock),
        "shared": of(EXCHANGES) / clock,
        "memory": size / (gpu.gigabytes * 1e9),
    }


def milliseconds(gpu: Gpu, of: Work | CaseSpec) -> Iterator[tuple[str, float, str]]:
    """The name, milliseconds and limiting part of the card of each kernel, then of each sort."""
    work = of if isinstance(of, Work) else work_of(of)
    made = launched(work)
    programs = {
        kernel.name: kernel
        for module in dict.fromkeys(it.module for it in made.values())
        for kernel in kernels(ptx_of(module, ARCH))
    }
    for name, it in made.items():
        parts = seconds(gpu, counted(programs[name], it.turns), it.warps, it.bytes)
        limit: Callable[[str], float] = parts.__getitem__
        slowest = max(parts, key=limit)
        yield name, parts[slowest] * 1e3, slowest
    for name, size in sorting(work).items():
        yield name, size / gpu.gigabytes / 1e6, "memory"


def card_of(name: str) -> Gpu | None:
    """The card that a driver calls so, such as "NVIDIA GeForce RTX 4090"; None for one that is not known."""
    return next(
        (gpu for card, gpu in CARDS.items() if re.search(rf"\b{card}\b(?! (?:Ti|SUPER|Laptop|D)\b)", name)),
        None,
    )


class Timed:
    """A `Launch` that waits for each kernel and notes how long it took."""

    def __init__(self, launch: Launch, now: Callable[[], float]) -> None:
        """Args: now, seconds on a clock that waits for the device."""
        self._launch, self._now = launch, now
        self.seconds: dict[str, list[float]] = {}

    def __call__(self, kernel: str, grid: tuple[int, int], block: int, /, **arguments: Argument) -> None:
        """Launches a kernel as `parts.Launch` does, and waits for it."""
        start = self._now()
        self._launch(kernel, grid, block, **arguments)
        self.seconds.setdefault(kernel, []).append(self._now() - start)


def measured(case: Case, repeats: int) -> dict[str, float]:
    """Milliseconds of each kernel in an iteration on the device of the case: medians after a warm-up."""
    step = TrainingStep(case, case.views[0])
    launch = ops.launcher(case.gaussians.means.device)
    assert launch is not None
    timed = Timed(launch, step.now)
    with mock.patch.object(ops, "launcher", return_value=timed):
        for _ in range(2):  # the second one has room for pairs
            step.iteration()
        timed.seconds.clear()
        for _ in range(repeats):
            step.iteration()
    return {name: median(took) * 1e3 for name, took in timed.seconds.items()}


def baking(case: Case, repeats: int) -> float:
    """Milliseconds of baking a view around an eighth of the Gaussians: the median after a warm-up."""
    step, own = TrainingStep(case, case.views[0]), len(case.gaussians) // 8
    return step.milliseconds(
        lambda: bake(case.gaussians, own, step.view.camera, near=case.near, unit=1.0), repeats
    )


def comparison(took: Mapping[str, float], expected: Mapping[str, float]) -> str:
    """A table in Markdown of the kernels as measured and as the model has them."""
    rows = [
        (name, ms, expected.get(name), 100 * expected[name] / ms if name in expected else None)
        for name, ms in took.items()
    ]
    return report.markdown(("kernel", "ms", "model ms", "of the model's peak %"), rows)


def main(arguments: list[str] | None = None) -> int:
    """The program; returns its exit code."""
    parser = report.parser("rasterizer.roofline", __doc__)
    parser.add_argument("--width", type=int, default=2048, help="of the panorama, in pixels")
    parser.add_argument("--gaussians", type=int, default=1_000_000, help="of a random street")
    parser.add_argument(
        "--cards", type=lambda text: text.split(","), default=list(CARDS), help="of the table"
    )
    options = parser.parse_args(arguments)
    if unknown := set(options.cards) - set(CARDS):
        parser.error(f"no card {min(unknown)}: there are {', '.join(CARDS)}")
    if options.quick:
        options.width, options.gaussians = 256, 5_000

    def made() -> report.Report:
        spec = CaseSpec(options.width, options.gaussians)
        work = work_of(spec)
        found = {card: list(milliseconds(CARDS[card], work)) for card in options.cards}
        names = [name for name, _, _ in found[options.cards[0]]]
        rows = [
            (name, *(f"{found[card][place][1]:.3f} {found[card][place][2]}" for card in options.cards))
            for place, name in enumerate(names)
        ]
        totals = {card: math.fsum(took for _, took, _ in each) for card, each in found.items()}
        rows.append(("in all", *(f"{total:.2f}" for total in totals.values())))
        text = "A model, not a measurement: ms of each kernel at its peak, and what limits it.\n\n"
        text += report.markdown(("kernel", *options.cards), rows)
        content: dict[str, object] = {"model": True, "work": asdict(work), "total_ms": totals}
        content["kernels_ms"] = {card: {n: took for n, took, _ in each} for card, each in found.items()}
        return report.Report(content, text)

    return report.run("rasterizer.roofline", options, made)


if __name__ == "__main__":
    sys.exit(main())
