"""What a variant has come to on a scene, and how it is kept."""

import json
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from statistics import fmean, stdev
from typing import Any

from panolog.orchestrator.runs.folder import write_json
from panolog.orchestrator.runs.units import means

METRICS = ("psnr", "ssim", "lpips", "lpips_3dgs", "ws_psnr", "ws_ssim", "twice_ws_psnr")
_UNTRAINED = ("measure", "eval", "")  # stages that no training needs


@dataclass(frozen=True)
class Point:
    """The quality of one state of a run."""

    seconds: float  # since its first task began
    ws_psnr: float  # dB, mean over the held-out panoramas
    stage: str  # "coarse" or "block"


@dataclass(frozen=True)
class Result:
    """One run: means over the held-out panoramas; wall-clock seconds by stage, from the first task on."""

    scene: str
    variant: str
    seed: int
    iterations: int = 0  # of Stage I, and of each block
    blocks: int = 0  # trained
    densified: tuple[int, ...] = ()  # how often Gaussians have, in Stage I and in each block
    resets: tuple[int, ...] = ()  # of opacities, likewise
    metrics: dict[str, float | None] = field(default_factory=dict)  # those of METRICS
    gaussians: int = 0  # sky included
    bytes: int = 0  # of the PLY
    seconds: dict[str, float] = field(default_factory=dict)
    longest: float = 0.0  # seconds of the block that trained longest
    threads: int = 0  # of each task on a CPU: tasks run one at a time
    memory: int | None = None  # bytes, the largest peak of a task's process
    overlap: float | None = None  # blocks that a camera trains on average
    added: float | None = None  # assignments that gradients add, as a share of all
    curve: tuple[Point, ...] = ()
    notes: tuple[str, ...] = ()
    settings: dict[str, Any] = field(default_factory=dict)  # resolved, by dotted key
    sources: str = ""  # fingerprint of the code that has measured it
    code: str = ""  # the same for readers
    machine: str = ""  # the hardware and versions that it was measured on
    same_as: str = ""  # the variant with the same training or the same plan, which has not run again
    failed: str = ""  # why there is nothing else

    @property
    def total(self) -> float:
        """Seconds from the first task to the merged model."""
        return sum(value for stage, value in self.seconds.items() if stage not in _UNTRAINED)

    @property
    def training(self) -> float:
        """Of these, the seconds that grow with the iterations."""
        return self.seconds.get("coarse", 0.0) + self.seconds.get("block", 0.0)

    def iterations_in(self, seconds: float) -> int:
        """The iterations of each stage with which it would have taken so long, at its seconds of each."""
        rest = self.total - self.training
        return max(1, round(self.iterations * (seconds - rest) / self.training))

    @property
    def model(self) -> str:
        """The variant that has made its model."""
        return self.same_as or self.variant

    @property
    def on_workers(self) -> float:
        """The same if each block had a machine like this one: with the longest block in place of Stage II."""
        return self.total - self.seconds.get("block", 0.0) + self.longest

    def metric(self, name: str) -> float | None:
        """One of METRICS, if it was measured."""
        return self.metrics.get(name)


def save(path: Path, result: Result) -> None:
    """Writes one result as JSON."""
    write_json(path, asdict(result))


def from_json(stored: dict[str, Any]) -> Result:
    """The inverse of `dataclasses.asdict`, without what results of earlier versions had besides."""
    curve = tuple(Point(**point) for point in stored["curve"])
    lists: dict[str, Any] = {
        key: tuple(stored[key]) for key in ("notes", "densified", "resets") if key in stored
    }
    own = {name: value for name, value in stored.items() if name in Result.__dataclass_fields__}
    return Result(**{**own, **lists, "curve": curve})


def load(path: Path) -> Result | None:
    """The result that `save` wrote, None if there is none."""
    return from_json(json.loads(path.read_bytes())) if path.exists() else None


@dataclass(frozen=True)
class Spread:
    """A figure over seeds."""

    mean: float
    deviation: float | None = None  # the standard deviation of a sample; None for one seed

    def __str__(self) -> str:
        digits = max(0, 4 - len(str(int(abs(self.mean))))) if abs(self.mean) >= 1 else 4  # as report.markdown
        tail = "" if self.deviation is None else f" ± {self.deviation:.{digits}f}"
        return f"{self.mean:.{digits}f}{tail}"

    @property
    def signed(self) -> str:
        """As a difference in dB."""
        return f"{self.mean:+.2f}" + ("" if self.deviation is None else f" ± {self.deviation:.2f}")


def spread(values: Iterable[float | None]) -> Spread | None:
    """Mean and deviation of what there is."""
    found = [value for value in values if value is not None]
    if not found:
        return None
    return Spread(fmean(found), stdev(found) if len(found) > 1 else None)


def _mean(scene: str, found: Sequence[Result]) -> Result:
    """The means of what a variant has come to on several scenes, as of one scene."""
    stages = {stage for result in found for stage in result.seconds}
    return replace(
        found[0],
        scene=scene,
        metrics=means(result.metrics for result in found),
        gaussians=round(fmean(result.gaussians for result in found)),
        bytes=round(fmean(result.bytes for result in found)),
        seconds={stage: fmean(result.seconds.get(stage, 0.0) for result in found) for stage in stages},
        longest=fmean(result.longest for result in found),
        memory=max((result.memory for result in found if result.memory), default=None),
        notes=(f"mean over {len(found)} scenes",),
    )


@dataclass(frozen=True)
class Results:
    """All results of a command, of which tables, goals and pictures are functions."""

    all: Sequence[Result]

    @property
    def scenes(self) -> list[str]:
        """In the order of the command."""
        return list(dict.fromkeys(result.scene for result in self.all))

    def of(self, scene: str, variant: str) -> list[Result]:
        """The results of all seeds, without those that failed."""
        return [r for r in self.all if (r.scene, r.variant) == (scene, variant) and not r.failed]

    def first(self, scene: str, variant: str) -> Result | None:
        """That of the first seed."""
        return next(iter(self.of(scene, variant)), None)

    def mean(self, name: str, scenes: Sequence[str]) -> "Results":
        """What all of these scenes have, as of one scene with this name: means over the scenes."""
        made = dict[tuple[str, int], list[Result]]()
        for result in (it for it in self.all if it.scene in scenes and not it.failed):
            made.setdefault((result.variant, result.seed), []).append(result)
        return Results([_mean(name, found) for found in made.values() if len(found) == len(scenes)])

    @property
    def codes(self) -> dict[str, str]:
        """Names of the codes that have measured them by fingerprint, those of the latest results last."""
        return {result.sources: result.code for result in self.all if result.sources}

    @property
    def machines(self) -> list[str]:
        """The machines that have measured the results, in the order of these."""
        return list(dict.fromkeys(result.machine for result in self.all if result.machine))

    def failure(self, scene: str, variant: str) -> str:
        """Why a variant has no result; empty if it has one or was not run."""
        reasons = [r.failed for r in self.all if (r.scene, r.variant) == (scene, variant) and r.failed]
        return "" if self.of(scene, variant) or not reasons else reasons[0]

    def gain(self, scene: str, variant: str, base: str, metric: str = "ws_psnr") -> Spread | None:
        """How much a variant is above another, over the seeds that both have."""
        others = {result.seed: result.metric(metric) for result in self.of(scene, base)}
        pairs = [(r.metric(metric), others.get(r.seed)) for r in self.of(scene, variant)]
        return spread(a - b for a, b in pairs if a is not None and b is not None)
