"""What `panolog scene depth` does: makes depth maps, and reports how they fit the sparse points (eq. 4)."""

from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from panolog.prepare.networks.depth_maps import make_depth, plan_depth
from panolog.prepare.networks.inverse_depth import NEAREST
from panolog.prepare.panorama_files import list_posed_panoramas
from panolog.scene.depth_alignment import Alignment, AlignmentError, align_depth
from panolog.scene.image_files import read_info
from panolog.scene.images import load_layers
from panolog.scene.model import Scene
from panolog.scene.read import read_scene
from panolog.scene.write import Progress, StageProgress


@dataclass(frozen=True)
class MapAlignment:
    """The depth map of one panorama. Training leaves out a map without alignment."""

    name: str
    alignment: Alignment | None
    reason: str = ""  # why there is none

    def as_json(self) -> dict[str, Any]:
        """The map as `panolog scene depth --json` has it."""
        content = asdict(self.alignment) if self.alignment else {}
        return {"name": self.name, **content, **({"reason": self.reason} if self.reason else {})}

    def line(self) -> str:
        """The map as a line of text."""
        if self.alignment is None:
            return f"{self.name}: left out: {self.reason}"
        it = self.alignment
        residual = f"residual {it.residual:.3f}, " if it.residual is not None else ""
        share = f"{it.inliers} of {it.points} points" if it.points else "too few points to compare it with"
        origin = ", given with the scene" if it.given else f"; {it.note}" if it.note else ""
        return f"{self.name}: scale {it.scale:.5g}, offset {it.offset:.4g}, {residual}{share}{origin}"


@dataclass(frozen=True)
class DepthReport:
    """The depth maps of a scene, and how they fit it."""

    made: int  # panoramas by this call
    kept: int  # made by the same network before
    given: int  # maps of the user
    device: str
    metric: bool  # the maps were all made by a network that estimates metres
    maps: tuple[MapAlignment, ...]

    def as_json(self) -> dict[str, Any]:
        """The report as `--json` prints it: medians are of the maps that fit, None where none does."""
        found = [it.alignment for it in self.maps if it.alignment is not None]

        def median(values: list[float]) -> float | None:
            return float(np.median(values)) if values else None

        scale = median([it.scale for it in found])
        return {
            "made": self.made,
            "kept": self.kept,
            "given": self.given,
            "device": self.device,
            "metres_per_unit": scale * NEAREST if self.metric and scale is not None else None,
            "maps": len(self.maps),
            "aligned": len(found),
            "scale": scale,
            "residual": median([it.residual for it in found if it.residual is not None]),
            "inliers": median([it.inliers / it.points for it in found if it.points]),
            "images": [it.as_json() for it in self.maps],
        }

    def lines(self) -> Iterator[str]:
        """The report as lines of text."""
        content = self.as_json()
        yield from (it.line() for it in self.maps)
        yield f"{self.made} maps made, {self.kept} kept, {self.given} given"
        yield f"{content['aligned']} of {content['maps']} fit the sparse points"
        if content["aligned"]:
            residual = f", residual {content['residual']:.3f}" if content["residual"] is not None else ""
            yield f"median scale {content['scale']:.5g}{residual}"
        if content["metres_per_unit"] is not None:
            yield f"the network estimates one world unit as {content['metres_per_unit']:.4g} m"


def align_depth_maps(scene: Scene, progress: Progress) -> list[MapAlignment]:
    """Aligns each depth map of the scene at its own size, as training does with its default settings.

    Args: progress, called after each map.
    Raises InputError: a layer cannot be decoded.
    """
    found = []
    rows = [row for row, panorama in enumerate(scene.panoramas) if panorama.depth is not None]
    for done, row in enumerate(rows, 1):
        panorama = scene.panoramas[row]
        assert panorama.depth is not None
        view = load_layers(panorama, row, read_info(panorama.depth).width)
        try:
            found.append(MapAlignment(panorama.name, align_depth(scene, view, seed=0)))
        except AlignmentError as error:
            found.append(MapAlignment(panorama.name, None, str(error)))
        progress(done, len(rows))
    return found


def estimate_depth(
    scene: Path, model: Path, *, batch: int, device: str, say: Callable[[str], None], progress: StageProgress
) -> DepthReport:
    """Writes the depth maps and sky masks of a scene that are missing, and aligns all (eq. 4).

    Raises InputError if a panorama, the network or the device cannot be used; RunError if the network fails.
    """
    job = plan_depth(list_posed_panoramas(scene), model, device)
    say(f"{len(job.todo)} panoramas on {job.network.device}; {job.done} are done, {job.given} maps are given")
    make_depth(job, batch, partial(progress, "depth"))
    maps = align_depth_maps(read_scene(scene), partial(progress, "alignment"))
    metric = job.manifest.depth.factor is not None and not job.given
    return DepthReport(len(job.todo), job.done, job.given, job.network.device, metric, tuple(maps))
