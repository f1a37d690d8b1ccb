"""How the depth maps of a scene fit its sparse points: one line for each panorama (eq. 4)."""

from collections.abc import Iterator
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from panolog.scene.depth_alignment import Alignment, AlignmentError, align_depth
from panolog.scene.image_files import read_info
from panolog.scene.images import load_layers
from panolog.scene.model import Scene


@dataclass(frozen=True)
class MapAlignment:
    """One panorama. Without an alignment training leaves its map out."""

    name: str
    alignment: Alignment | None
    reason: str = ""  # why there is none
    iteration: int = 0
    iterations: int = 0

    def as_json(self) -> dict[str, Any]:
        """As `panolog scene depth --json` has it."""
        found = asdict(self.alignment) if self.alignment else {}
        return {"name": self.name, **found, **({"reason": self.reason} if self.reason else {})}

    def line(self) -> str:
        """As people read it."""
        if self.alignment is None:
            return f"{self.name}: left out: {self.reason}"
        it = self.alignment
        share = f"{it.inliers} of {it.points} points" if it.points else "given with the scene"
        return (
            f"{self.name}: scale {it.scale:.5g}, offset {it.offset:.4g}, residual {it.residual:.3f}, {share}"
        )


def align_depth_maps(scene: Scene) -> Iterator[MapAlignment]:
    """Aligns each depth map of the scene at its own size, as training will; who has none is missing.

    Raises:
        SceneError: a layer cannot be decoded.
    """
    rows = [row for row, panorama in enumerate(scene.panoramas) if panorama.depth is not None]
    for done, row in enumerate(rows, 1):
        panorama = scene.panoramas[row]
        assert panorama.depth is not None
        width = read_info(panorama.depth).width
        try:
            found = align_depth(scene, load_layers(panorama, row, width), seed=0)
        except AlignmentError as error:
            yield MapAlignment(panorama.name, None, str(error), done, len(rows))
        else:
            yield MapAlignment(panorama.name, found, "", done, len(rows))


def summary(rows: list[MapAlignment]) -> dict[str, Any]:
    """The table in numbers: how many fit, and medians of those that do (None where none does)."""
    found = [row.alignment for row in rows if row.alignment is not None]

    def median(values: list[float]) -> float | None:
        return float(np.median(values)) if values else None

    return {
        "maps": len(rows),
        "aligned": len(found),
        "scale": median([it.scale for it in found]),
        "residual": median([it.residual for it in found]),
        "inliers": median([it.inliers / it.points for it in found if it.points]),
    }
