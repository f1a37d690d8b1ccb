"""What is simulated: how many blocks on how many machines for how long, and how often they report."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

HOUR = 3600.0
GPUS = 4  # of each machine
NOISE = 0.05  # by which the seconds of a block differ from the power law that the driver fits
_EXPONENT = 0.25  # of that law, in Gaussians
_BUSY = 0.92  # of the run: what is left for Stage I, faults and the last blocks


@dataclass(frozen=True)
class Load:
    """One simulated run. Intervals in seconds."""

    blocks: int
    machines: int
    hours: float  # that the run takes, roughly
    tick: float = 5.0  # that the clock jumps: messages in between arrive together
    progress: float = 60.0  # between two messages of a task
    checkpoint: float = 600.0
    usage: float = 600.0  # between two measurements of a machine
    previews: int = 60  # of each block
    notices: int = 5  # of each attempt
    iterations: int = 30_000
    seed: int = 0
    without: tuple[str, ...] = ()  # values of `faults.Fault` that do not happen

    @property
    def seconds(self) -> float:
        """Of the whole run, roughly."""
        return self.hours * HOUR

    @cached_property
    def gaussians(self) -> list[int]:
        """Of Stage I in each block."""
        random = np.random.default_rng([self.seed, 2])
        return [int(count) + 1 for count in random.lognormal(2.5, 0.8, self.blocks)]

    def block_seconds(self, speed: float) -> list[float]:
        """Of each block on a GPU of slowness 1. Args: speed, of all GPUs together."""
        random = np.random.default_rng([self.seed, 3])
        shape = np.array(self.gaussians) ** _EXPONENT * random.lognormal(0, NOISE, self.blocks)
        return [float(part) for part in shape * (_BUSY * self.seconds * speed / shape.sum())]
