"""What `panolog scene mask` tells at its end."""

from collections.abc import Iterator, Sequence
from typing import Any

from panolog.prepare.networks.masks import MaskResult, share_of_sphere
from panolog.prepare.networks.static_regions import StaticRegion


def report(masks: Sequence[MaskResult], static: StaticRegion | None) -> dict[str, Any]:
    """What `--json` prints. Shares are of the sphere."""
    return {
        "made": sum(mask.fresh for mask in masks),
        "kept": sum(not mask.fresh for mask in masks),
        "static": None if static is None else share_of_sphere(static.panorama(512)),
        "images": [{"name": mask.name, "ignored": mask.ignored} for mask in masks],
    }


def lines(described: dict[str, Any]) -> Iterator[str]:
    """The same for people."""
    for image in described["images"]:
        yield f"{image['name']}: {image['ignored']:.1%} of the sphere is ignored"
    if described["static"] is not None:
        yield f"{described['static']:.1%} of the sphere stays the same while the camera moves"
    yield f"{described['made']} masks made, {described['kept']} were there"
