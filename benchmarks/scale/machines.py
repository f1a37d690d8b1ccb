"""Which machine, and for how many hours: the product's estimate, on a model of GPUs instead of a calibration.

No card has been measured. An iteration is assumed to take as long as one of gsplat with as many Gaussians and
pixels on the card on which its authors have measured it, over the ratio of the cards' memory bandwidths. The
paper reports no times.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from benchmarks.paper.reference import BYTES, SCENES
from benchmarks.scale.laws import settings
from benchmarks.scale.models import PER_BLOCK
from benchmarks.scale.places import city
from panolog.orchestrator.estimates.calibration import Basis, assumed
from panolog.orchestrator.estimates.costs import Estimate
from panolog.orchestrator.estimates.estimate import Estimator
from panolog.orchestrator.estimates.suggestions import balanced
from panolog.orchestrator.resources.nodes import Gpu, Node
from panolog.orchestrator.run.config import RunConfig, change
from panolog.scene.model import Scene
from panolog.scene.ply import COLUMNS
from panolog.workers import device_memory
from panolog.workers.tasks import Stage

# gsplat's own evaluation (docs/source/tests/eval.rst in its repository): 30,000 iterations on a TITAN RTX.
# Gaussians at the end in millions, megapixels of an image of Mip-NeRF 360 as it is trained, seconds.
_GSPLAT = (
    (6.26, 1.017, 2964.0),  # bicycle
    (1.25, 1.620, 1422.0),  # bonsai
    (1.21, 1.617, 1621.0),  # counter
    (5.84, 1.089, 3013.0),  # garden
    (1.79, 1.619, 2020.0),  # kitchen
    (1.59, 1.616, 1708.0),  # room
    (4.81, 1.027, 2299.0),  # stump
)
_STEPS = 30_000
_TITAN_RTX = 672.0  # GB/s of memory, as the vendor says; so are those below
_CORES = 8  # of the host, for each GPU
_PANORAMAS = 5637  # of the paper's four scenes; it does not say how many each has
WIDTH = 3840
DISTRICT = round(_PANORAMAS / 4)  # panoramas of one of them, and of a city's district
_DECODE = 0.25  # seconds of a panorama of that width on a core, assumed


@dataclass(frozen=True)
class Card:
    """A GPU."""

    name: str
    memory: int  # bytes that are free
    bandwidth: float  # GB/s


@dataclass(frozen=True)
class Machines:
    """So many equal GPUs, in nodes of up to eight."""

    card: Card
    count: int

    @property
    def name(self) -> str:
        """Such as 8 × RTX 4090."""
        return f"{self.count} × {self.card.name}"

    @property
    def nodes(self) -> tuple[Node, ...]:
        """With 64 GB of memory for each GPU."""
        sizes = [min(8, self.count - first) for first in range(0, self.count, 8)]
        gpu = Gpu(self.card.name, self.card.memory)
        return tuple(Node(str(i), str(i), _CORES * n, n * 2**36, (gpu,) * n) for i, n in enumerate(sizes))


RTX_4090, _H100 = Card("RTX 4090", 23 * 2**30, 1008.0), Card("H100", 78 * 2**30, 3350.0)
MACHINES = (Machines(RTX_4090, 1), Machines(RTX_4090, 8), Machines(_H100, 64))


@dataclass(frozen=True)
class Hours:
    """A place on some machines. Bytes of a GPU, of the largest task."""

    place: str
    recipe: str
    machines: str
    districts: int
    blocks: int
    gaussians: int  # of the merged model
    memory: int
    fits: bool
    coarse: float  # hours, districts included
    refinement: float  # hours: scores and blocks
    total: float  # hours, with merge and evaluation


def law() -> tuple[float, float]:
    """Milliseconds of a million Gaussians and of a million pixels in an iteration on a TITAN RTX."""
    table = np.array(_GSPLAT)
    cost, *_ = np.linalg.lstsq(table[:, :2], 1e3 * table[:, 2] / _STEPS, rcond=None)
    return float(cost[0]), float(cost[1])


def spread() -> float:
    """The largest error of that law among its own samples, as a fraction."""
    table = np.array(_GSPLAT)
    predicted = table[:, :2] @ np.array(law())
    return float(np.abs(predicted * _STEPS / 1e3 / table[:, 2] - 1).max())


def seconds(gaussians: float, pixels: float, card: Card) -> float:
    """Of an iteration, by the law."""
    each, pixel = law()
    return (each * gaussians + pixel * pixels) / 1e9 * _TITAN_RTX / card.bandwidth


def hours(panoramas: int, machines: Sequence[Machines] = MACHINES) -> Iterator[Hours]:
    """The paper's scenes, then a city of so many panoramas in the recipe that is the default."""
    each = DISTRICT
    scene = city(each, WIDTH)
    for name in ("nsc", "nsk", "bax", "nsn"):
        size = next(row.size for row in SCENES[name].rows if row.method == "PanoLOG (paper)") or 0.0
        count = round(size * BYTES / (4 * len(COLUMNS)))
        config = RunConfig.model_validate(
            {"recipe": "paper", "width": WIDTH, "device": "cuda", "densify": {"max_gaussians": count}}
        )
        for on in machines:
            yield _hours(name.upper(), scene, config, on)
    large = city(panoramas, WIDTH)
    districts = max(1, panoramas // each)
    blocks = max(2, round(panoramas / PER_BLOCK))
    config = change(settings(WIDTH, "cuda"), {"districts": districts})
    config = change(config, balanced(large, config, blocks))
    for on in machines:
        yield _hours(f"a city of {panoramas:,}", large, config, on)


def _hours(place: str, scene: Scene, config: RunConfig, machines: Machines) -> Hours:
    estimate = Estimator(scene, config, basis_on(scene, config, machines.card), machines.nodes).estimate()
    memory = max(stage.device for stage in estimate.stages)
    return Hours(
        place=place,
        recipe=config.recipe,
        machines=machines.name,
        districts=config.districts,
        blocks=config.grid.count,
        gaussians=next(stage.gaussians for stage in estimate.stages if stage.name is Stage.MERGE),
        memory=memory,
        fits=memory <= machines.card.memory,
        coarse=_sum(estimate, (Stage.DISTRICT, Stage.COARSE)),
        refinement=_sum(estimate, (Stage.SCORE, Stage.BLOCK)),
        total=(estimate.seconds or math.nan) / 3600,
    )


def _sum(estimate: Estimate, names: Sequence[Stage]) -> float:
    return sum(stage.seconds or 0.0 for stage in estimate.stages if stage.name in names) / 3600


def basis_on(scene: Scene, config: RunConfig, card: Card) -> Basis:
    """What a calibration would have measured if the law held."""
    basis, pixels = assumed(scene, config), scene.width * (scene.width // 2)
    first = basis.measured.initial
    views = first.device - device_memory.training(first.gaussians, pixels)
    count = 2 * first.gaussians
    grown = replace(
        first,
        gaussians=count,
        seconds=seconds(count, pixels, card),
        device=device_memory.training(count, pixels) + views,
    )
    measured = replace(
        basis.measured,
        threads=_CORES,
        decode=_DECODE,
        initial=replace(first, seconds=seconds(first.gaussians, pixels, card)),
        grown=grown,
        single=grown.seconds,
        look=grown.seconds,
    )
    return Basis(measured, startup=10.0)
