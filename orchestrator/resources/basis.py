"""What an estimate builds on: a calibration of the job, or what other jobs had, and sizes that the code has.

Each Gaussian has 59 floats of 4 bytes. Training keeps of each its value, gradient and two moments of Adam;
the rasterizer a splat of 64 bytes and a few entries of tiles. A densification has the new values beside the
old ones, and where those and the old moments were the next ones, which are larger, find no room: 1.5 to 1.9
kB for each Gaussian were measured in all. A checkpoint is a copy of values and moments.
"""

import json
from dataclasses import asdict, dataclass
from typing import Any

from pydantic import TypeAdapter

from panolog.orchestrator.run.config import RunConfig
from panolog.orchestrator.run.folder import RunFolder
from panolog.scene.model import Scene
from panolog.workers.events import Calibration, IterationCost
from panolog.workers.tasks import CALIBRATE

VALUES = 59 * 4  # bytes of one Gaussian's parameters
SPLAT = 64 + 56  # of the rasterizer's: the splat, some tile entries, the screen gradient
STEP = 4 * VALUES + SPLAT  # values, gradient, both moments
REARRANGED = 3 * VALUES + 16  # after a densification: where the old values and moments were, the indices
CHECKPOINT = 3 * VALUES + 16  # values, moments, statistics
TRAINED = STEP + REARRANGED  # peak bytes of one Gaussian in training, checkpoints aside
PIXEL = 20 * 3 * 4  # bytes of one pixel of a training step: some twenty float images
_PROCESS = 500 * 2**20  # bytes of a worker that trains, without Gaussians, images and panoramas
_SHARE = 0.2  # of Gaussians that densify at first: three scenes had 0.04 to 0.45


@dataclass(frozen=True)
class Basis:
    """A calibration, and how long its worker took to start."""

    measured: Calibration
    startup: float  # seconds from the start of a task to its first word
    timed: bool = True  # False: nothing was measured, and times are not known

    def as_json(self) -> dict[str, Any]:
        """For `preflight.json`, where the calibration has the name of its task."""
        task = str(CALIBRATE) if self.timed else ""
        return asdict(self) | {"measured": {"task": task} | asdict(self.measured)}


def assumed(scene: Scene, config: RunConfig) -> Basis:
    """Without a calibration: memory and growth as other scenes had them, and no times."""
    width = config.width or scene.width
    gaussians = len(scene.points) + config.sky.count
    trained = width * (width // 2) * PIXEL + gaussians * TRAINED
    cuda = config.device == "cuda"
    sample = IterationCost(gaussians, 0.0, _PROCESS + (not cuda) * trained, cuda * trained)
    measured = Calibration(
        width=width,
        threads=1,
        images=0,
        begin=0.0,
        decode=0.0,
        share=_SHARE,
        initial=sample,
        grown=sample,
        single=0.0,
        look=0.0,
    )
    return Basis(measured, 0.0, timed=False)


def basis_of(folder: RunFolder, scene: Scene, config: RunConfig) -> Basis:
    """What the run was estimated on when it began; assumptions for one that is older than preflights."""
    try:
        return TypeAdapter(Basis).validate_python(json.loads(folder.preflight.read_bytes())["basis"])
    except (OSError, ValueError, KeyError, TypeError):  # without it a run can go on just as well
        return assumed(scene, config)
