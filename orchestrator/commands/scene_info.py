"""`panolog scene info`: what a scene holds, in numbers."""

from collections.abc import Iterator
from typing import Any

from panolog.partition.bounds import aabb, baseline
from panolog.partition.config import PartitionConfig
from panolog.scene.model import Scene


def describe(scene: Scene) -> dict[str, Any]:
    """What `panolog scene info --json` prints. Lengths are in world units."""
    centers = scene.centers[list(scene.train)]
    box = aabb(centers, PartitionConfig().rho_tri)
    panoramas = scene.panoramas
    return {
        "path": str(scene.root),
        "fingerprint": scene.fingerprint,
        "panoramas": len(panoramas),
        "width": scene.width,
        "height": scene.height,
        "train": [panoramas[row].name for row in scene.train],
        "test": [panoramas[row].name for row in scene.test],
        "masks": sum(panorama.mask is not None for panorama in panoramas),
        "sky_masks": sum(panorama.sky_mask is not None for panorama in panoramas),
        "depths": sum(panorama.depth is not None for panorama in panoramas),
        "depth_affines": sum(panorama.depth_affine is not None for panorama in panoramas),
        "points": len(scene.points),
        "observations": sum(len(panorama.observed) for panorama in panoramas),
        "baseline": baseline(centers),
        "aabb": {"lower": box.lower.tolist(), "upper": box.upper.tolist()},
    }


def lines(info: dict[str, Any]) -> Iterator[str]:
    """The same for people."""
    yield f"{info['path']}: {info['panoramas']} panoramas of {info['width']}x{info['height']} pixels"
    yield f"split: {len(info['train'])} to train on, {len(info['test'])} held out"
    yield f"sparse cloud: {info['points']:,} points, {info['observations']:,} observations"
    yield f"beside them: {info['masks']} masks, {info['sky_masks']} sky masks, {info['depths']} depth maps"
    yield f"median distance to the nearest camera: {info['baseline']:.4g} world units"
    lower, upper = (", ".join(f"{x:.4g}" for x in info["aabb"][side]) for side in ("lower", "upper"))
    yield f"effective volume: ({lower}) to ({upper})"
