"""What `panolog scene info` shows."""

from collections.abc import Iterator
from typing import Any

from panolog.orchestrator.runs.config import RunConfig
from panolog.partition.bounds import baseline
from panolog.prepare.check.layers import look_at_layers
from panolog.scene.model import Scene
from panolog.scene.stores.stored_scenes import url_of


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
        "layers": list(look_at_layers(scene).lines),
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
    yield from info["layers"]
    if info["transparent"]:
        yield f"{info['transparent']} panoramas with an alpha channel: what is transparent in them is ignored"
    yield f"median distance to the nearest camera: {info['baseline']:.4g} world units"
    lower, upper = (", ".join(f"{x:.4g}" for x in info["aabb"][side]) for side in ("lower", "upper"))
    yield f"effective volume: ({lower}) to ({upper})"
    if any(info["offset"]):
        x, y, z = info["offset"]
        yield f"far from its origin: ({x:.0f}, {y:.0f}, {z:.0f}) is subtracted from all positions on reading"
