"""The memory of a training step of two sizes, against what is estimated before anything is measured."""

from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
import torch

from benchmarks.first_hour.outcome import Context, Outcome
from benchmarks.processes import in_fresh_process
from benchmarks.report import markdown
from panolog.orchestrator.engine.estimates.calibration import assumed
from panolog.orchestrator.runs.config import load_config
from panolog.scene.read import read_scene
from panolog.synthetic.make import make_town
from panolog.workers.calibration import CalibrateSpec
from panolog.workers.events import Calibration, IterationCost
from panolog.workers.specs import Value

HEAD = ("Gaussians", "size", "estimated MB", "measured MB", "error", "context and cache MB", "ms")
_SIZES = ((100_000, 512), (1_000_000, 1024))  # points, pixels of width
_REHEARSED = ((2_000, 64), (20_000, 128))
_POINTS = 1000  # of the town itself
_SECONDS = 3.0  # of iterations of each size
_ERROR = 0.1  # by which more than estimated may be needed


@dataclass(frozen=True)
class Row:
    """One size; bytes of the card, or of the process on the CPU."""

    gaussians: int
    width: int  # pixels
    estimated: int
    measured: int
    beyond: int | None  # on the card: its context and what torch's allocator keeps, with all other processes
    milliseconds: float  # of an iteration

    @property
    def error(self) -> float:
        """Of the estimate, as a fraction of what was measured."""
        return self.estimated / self.measured - 1

    def cells(self) -> tuple[object, ...]:
        """The row, in the order of HEAD."""
        size = f"{self.width}×{self.width // 2}"
        beyond = self.beyond and self.beyond / 1e6
        used = (self.estimated / 1e6, self.measured / 1e6, f"{self.error:+.0%}", beyond)
        return (self.gaussians, size, *used, self.milliseconds)


def compare(context: Context) -> Outcome:
    """Iterations of a calibration, as before each run, in a new process for each size."""
    rows: list[Row] = []
    outcome = Outcome("failed", reason="nothing was measured")
    sizes = _SIZES if context.cuda else _REHEARSED
    town = make_town(context.work / "town", panoramas=3, width=sizes[-1][1], points=_POINTS)
    for points, width in sizes:
        rows.append(in_fresh_process(measure, town, points, width, context.device))
        text = markdown(HEAD, [row.cells() for row in rows])
        figure = "estimate " + " and ".join(f"{row.error:+.0%}" for row in rows)
        content = {"rows": [asdict(row) for row in rows]}
        outcome = Outcome("passed", figure, content=content, text=text)
        if context.cuda and any(row.measured > row.estimated * (1 + _ERROR) for row in rows):
            outcome = Outcome("failed", figure, f"over {_ERROR:.0%} more than estimated", (), content, text)
        context.save(outcome)
    return outcome


def measure(town: Path, points: int, width: int, device: str) -> Row:
    """One size, in this process: a town among so many random points, at this width."""
    scene = read_scene(town)
    box = scene.points.min(0), scene.points.max(0)
    cloud = np.concatenate([scene.points, np.random.default_rng(0).uniform(*box, (points, 3))])
    scene = replace(scene, points=cloud, colors=np.full(cloud.shape, 128, np.uint8))
    config = load_config(flags={"device": device, "width": width, "sky.count": points // 100})
    spec = CalibrateSpec(
        scene=Value(scene),
        width=width,
        iterations=config.iterations,
        config=config,
        seed=config.seed,
        seconds=_SECONDS,
        most=0,  # no more Gaussians than the scene has points
        device=device,
    )
    *_, calibration = spec.run()
    assert isinstance(calibration, Calibration)
    found, expected = calibration.initial, assumed(scene, config).measured.initial
    beyond = _beyond() if device == "cuda" else None
    used = (_bytes(expected, device), _bytes(found, device))
    return Row(found.gaussians, width, *used, beyond, found.seconds * 1e3)


def _bytes(cost: IterationCost, device: str) -> int:
    return cost.device if device == "cuda" else cost.host


def _beyond() -> int:
    """Bytes of the card that are in use, but not by tensors at their peak."""
    free, total = torch.cuda.mem_get_info()
    return total - free - torch.cuda.max_memory_allocated()
