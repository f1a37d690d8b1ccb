"""The rows of the rasterizer's benchmark: one case at one number of threads, and the tables made of them."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import torch

from benchmarks.rasterizer.cases import CaseSpec
from benchmarks.rasterizer.iteration import Stages, Times, measure, stages
from benchmarks.rasterizer.memory import probe
from benchmarks.report import markdown

WIDTHS = (1024, 2048, 3840)
COUNTS = (50_000, 200_000, 1_000_000)
PARAMETERS = 59 * 4  # bytes of a Gaussian


@dataclass(frozen=True)
class Row:
    """A case at a number of threads, or on a GPU; means over its images."""

    model: str
    width: int  # pixels
    height: int
    gaussians: int
    device: str  # "cpu" or "cuda"
    threads: int  # of the host
    times: Times
    memory: int  # bytes at the peak of an iteration: model, moments, target, image and all buffers
    stages: Stages | None  # not on a GPU
    speed_up: float | None = None  # of the iteration, against the first row of this case

    @property
    def on(self) -> str:
        """The threads or the GPU."""
        if self.device == "cuda":
            return torch.cuda.get_device_name()
        return "1 thread" if self.threads == 1 else f"{self.threads} threads"

    def content(self) -> dict[str, Any]:
        """For JSON."""
        return asdict(self) | {"on": self.on, "shares": {"rasterization": self.times.share}}


Column = Callable[[Row], object]


_CASE: tuple[tuple[str, Column], ...] = (
    ("model", lambda row: row.model),
    ("size", lambda row: f"{row.width}×{row.height}"),
    ("Gaussians", lambda row: row.gaussians),
    ("on", lambda row: row.on),
)
TIMES: tuple[tuple[str, Column], ...] = (
    *_CASE,
    ("forward ms", lambda row: row.times.forward),
    ("loss ms", lambda row: row.times.loss),
    ("backward, Adam ms", lambda row: row.times.backward),
    ("iteration ms", lambda row: row.times.iteration),
    ("rasterization %", lambda row: 100 * row.times.share),
    ("Mpx/s", lambda row: row.width * row.height / row.times.iteration / 1e3),
    ("speed-up", lambda row: row.speed_up),
    ("peak MB", lambda row: row.memory / 1e6),
)
STAGES: tuple[tuple[str, Column], ...] = (
    *_CASE,
    ("project ms", lambda row: row.stages and row.stages.project),
    ("order ms", lambda row: row.stages and row.stages.order),
    ("composite ms", lambda row: row.stages and row.stages.composite),
    ("composite back ms", lambda row: row.stages and row.stages.composite_backward),
    ("project back, Adam ms", lambda row: row.stages and row.stages.project_backward),
)


def benchmark(specs: Iterable[CaseSpec], device: str, threads: Sequence[int], repeats: int) -> Iterator[Row]:
    """One row for each case and number of threads; one for each case on a GPU."""
    on_cpu = device == "cpu"
    for spec in specs:
        case = spec.make()
        camera = case.views[0].camera
        size, gaussians = (camera.width, camera.height), len(case.gaussians)
        case = case.to(device)
        state = 3 * PARAMETERS * gaussians + 3 * camera.width * camera.height  # with both moments; the target
        first: float | None = None
        for number in threads if on_cpu else threads[-1:]:
            memory = state + probe(spec, device, number)
            times = measure(case, number, repeats)
            spent = stages(case, number, repeats) if on_cpu else None
            gain = first and first / times.iteration
            first = first or times.iteration
            yield Row(case.name, *size, gaussians, device, number, times, memory, spent, gain)


def tables(rows: Sequence[Row]) -> str:
    """Tables in Markdown: times, and on the CPU the stages."""
    shown = [TIMES, STAGES] if rows[0].stages else [TIMES]
    return "\n\n".join(
        markdown([name for name, _ in columns], [[cell(row) for _, cell in columns] for row in rows])
        for columns in shown
    )
