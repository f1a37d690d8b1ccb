"""What `panolog scene info`, `scene mask` and `scene depth` do."""

from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any, Literal

from panolog.orchestrator.run.config import RunConfig
from panolog.partition.bounds import baseline
from panolog.prepare.networks.depth_maps import make_depth, plan_depth
from panolog.prepare.networks.depth_report import DepthReport, align_depth_maps, report_depth
from panolog.prepare.networks.masks import MaskJob, find_nadir, find_static, make_masks, masks_as_json
from panolog.prepare.networks.movers import MoverNetwork
from panolog.prepare.panorama_files import list_panoramas, list_posed_panoramas
from panolog.scene.model import Scene
from panolog.scene.read import read_scene
from panolog.scene.stores.outline import url_of
from panolog.scene.write import StageProgress


def describe(scene: Scene) -> dict[str, Any]:
    """What `panolog scene info --json` prints. Lengths are in world units."""
    centers = scene.centers[list(scene.train)]
    box = RunConfig().partition.box(centers)
    panoramas = scene.panoramas
    return {
        "path": url_of(scene.root) or str(scene.root),
        "fingerprint": scene.fingerprint,
        "panoramas": len(panoramas),
        "width": scene.width,
        "height": scene.height,
        "train": [panoramas[row].name for row in scene.train],
        "test": [panoramas[row].name for row in scene.test],
        "masks": sum(panorama.mask is not None for panorama in panoramas),
        "transparent": sum(panorama.transparent for panorama in panoramas),
        "sky_masks": sum(panorama.sky_mask is not None for panorama in panoramas),
        "depths": sum(panorama.depth is not None for panorama in panoramas),
        "depth_affines": sum(panorama.depth_affine is not None for panorama in panoramas),
        "points": len(scene.points),
        "observations": sum(len(panorama.observed) for panorama in panoramas),
        "baseline": baseline(centers),
        "offset": list(scene.offset),
        "aabb": {"lower": box.lower.tolist(), "upper": box.upper.tolist()},
    }


def lines(info: dict[str, Any]) -> Iterator[str]:
    """A description for people."""
    yield f"{info['path']}: {info['panoramas']} panoramas of {info['width']}x{info['height']} pixels"
    yield f"split: {len(info['train'])} to train on, {len(info['test'])} held out"
    yield f"sparse cloud: {info['points']:,} points, {info['observations']:,} observations"
    yield f"layers: {info['masks']} masks, {info['sky_masks']} sky masks, {info['depths']} depth maps"
    if info["transparent"]:
        yield f"{info['transparent']} panoramas with an alpha channel: what is transparent in them is ignored"
    yield f"median distance to the nearest camera: {info['baseline']:.4g} world units"
    lower, upper = (", ".join(f"{x:.4g}" for x in info["aabb"][side]) for side in ("lower", "upper"))
    yield f"effective volume: ({lower}) to ({upper})"
    if any(info["offset"]):
        x, y, z = info["offset"]
        yield f"far from its origin: ({x:.0f}, {y:.0f}, {z:.0f}) is subtracted from all positions on reading"


def mask_scene(
    scene: Path,
    *,
    nadir: float | Literal["auto"] | None,
    static: bool,
    model: Path | None,
    batch: int,
    device: str,
    progress: StageProgress,
) -> dict[str, Any]:
    """Writes the masks of a scene that are missing, and returns what `panolog scene mask --json` prints.

    Args: nadir, degrees around straight down, or "auto", what is black there; static, find the operator;
    model, an ONNX network for movers.
    Raises InputError if a panorama, the network or the device cannot be used.
    """
    pictures = list_panoramas(scene)
    movers = MoverNetwork(model, device, batch) if model is not None else None
    if nadir == "auto":
        nadir = find_nadir(pictures, partial(progress, "black nadir"))
    region = find_static(pictures, partial(progress, "static regions")) if static else None
    masks = make_masks(pictures, MaskJob(nadir, region, movers), partial(progress, "masks"))
    return masks_as_json(masks, region, nadir)


def estimate_depth(
    scene: Path, model: Path, *, batch: int, device: str, say: Callable[[str], None], progress: StageProgress
) -> DepthReport:
    """Writes the depth maps and sky masks of a scene that are missing, and aligns all (eq. 4).

    Raises InputError if a panorama, the network or the device cannot be used; RunError if the network fails.
    """
    job = plan_depth(list_posed_panoramas(scene), model, device)
    say(f"{len(job.todo)} panoramas on {job.network.device}; {job.done} are done, {job.given} maps are given")
    make_depth(job, batch, partial(progress, "depth"))
    return report_depth(job, align_depth_maps(read_scene(scene), partial(progress, "alignment")))
