"""What the masks of a scene leave out or call sky, and files of its layers that belong to no panorama."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from panolog.prepare.check.evidence import POINTS, points_seen
from panolog.prepare.networks.masks import share_of_sphere
from panolog.prepare.panorama_files import look_into
from panolog.prepare.provenance import read_mask
from panolog.scene.files import some_of
from panolog.scene.images import load_layers
from panolog.scene.model import Panorama, Scene
from panolog.scene.projection import project_to_pixels
from panolog.scene.read import DEPTHS, MASKS, SKY_MASKS

_LOOKED_AT = 48  # masks, evenly chosen
_MOST = 0.5  # of the sphere that masks leave out, or of the points on sky, from which on they may be inverted
_SKY_LOOKED_AT, _SKY_WIDTH = 16, 1024  # sky masks, and pixels across that each is looked at in
_BLACK = "black or transparent is what is ignored"

T = TypeVar("T")


@dataclass(frozen=True)
class Layers:
    """What was found in the layers of a scene, one line each."""

    lines: tuple[str, ...]  # how much of the sphere is masked or sky, and files that match nothing
    problems: tuple[str, ...]  # what nothing can be trained with
    inverted: tuple[str, ...]  # the same, if poses and points are right


def look_at_layers(scene: Scene) -> Layers:
    """What the masks of a scene leave out or call sky, and files in its layers that match nothing.

    Raises SceneError if a mask is damaged, or a sky mask is none.
    """
    shares, masks = _masks(scene)
    blank = len(masks) > 0 and shares.min() == 1
    wrong = [f"masks: nothing is left of {len(shares)} panoramas that were looked at; {_BLACK}"]
    sky, inverted = _sky(scene)
    return Layers((*masks, *sky, *_unmatched(scene)), tuple(wrong if blank else []), tuple(inverted))


def _masks(scene: Scene) -> tuple[NDArray[np.float64], list[str]]:
    """The shares of the sphere that some masks leave out, and lines of them; both empty without masks."""
    masks = {panorama.name: panorama.mask for panorama in scene.panoramas if panorama.mask is not None}
    if not masks:
        return np.zeros(0), []
    names = _some(list(masks), _LOOKED_AT)
    shares = np.array([share_of_sphere(~read_mask(masks[name])) for name in names])
    mean = float(shares.mean())
    some = f" of {len(names)} that were looked at" if len(names) < len(masks) else ""
    line = (
        f"masks: {len(masks)} of {len(scene.panoramas)} panoramas have one, and {mean:.1%} of the sphere is "
        f"ignored ({shares.min():.1%} to {shares.max():.1%}{some})"
    )
    if mean == 0:
        line += f"; nothing is: {_BLACK}"
    elif mean > _MOST:
        line += f"; that is most of it: {_BLACK}, invert them if it is to be used"
    blank = [name for name, share in zip(names, shares, strict=True) if share == 1]
    return shares, [line, *([f"masks: nothing is left of {some_of(blank, 'panorama')}"] if blank else [])]


def _sky(scene: Scene) -> tuple[list[str], list[str]]:
    """How much of the sphere is sky, and whether it is where the panoramas see points; none without masks."""
    having = [panorama for panorama in scene.panoramas if panorama.sky_mask is not None]
    if not having:
        return [], []
    looked_at = [_sky_of(scene, panorama) for panorama in _some(having, _SKY_LOOKED_AT)]
    share, points = (float(np.median(found)) for found in zip(*looked_at, strict=True))
    lines = [f"sky masks: {len(having)} of {len(scene.panoramas)} panoramas have one, and {share:.1%} is sky"]
    wrong = f"sky masks: {points:.0%} of what the panoramas see lies on their sky: black is sky; invert them"
    return lines, [wrong] if points > _MOST else []


def _sky_of(scene: Scene, panorama: Panorama) -> tuple[float, float]:
    """The share of the sphere, and of the points that a panorama sees, that are sky."""
    alone = replace(panorama, mask=None, depth=None, movers=None, transparent=False)
    sky = load_layers(alone, 0, min(_SKY_WIDTH, scene.width)).sky
    assert sky is not None
    seen = scene.points[points_seen(scene, panorama, POINTS)]
    _, v, u = project_to_pixels(panorama, seen, *sky.shape[::-1])
    on = sky.numpy()
    return share_of_sphere(on), float(on[v, u].mean())


def _some(items: Sequence[T], most: int) -> list[T]:
    """At most so many of some items, evenly chosen."""
    rows = np.unique(np.linspace(0, len(items) - 1, min(most, len(items))).astype(int))
    return [items[row] for row in rows]


def _unmatched(scene: Scene) -> list[str]:
    layers = {
        MASKS: {it.mask for it in scene.panoramas},
        SKY_MASKS: {it.sky_mask for it in scene.panoramas},
        DEPTHS: {it.depth for it in scene.panoramas},
    }
    lines = []
    for layer, used in layers.items():
        folder = scene.root / layer
        lost = [path for path in look_into(folder).images if path not in used]
        names = [path.relative_to(folder).as_posix() for path in lost]
        if names:
            lines.append(f"{layer}: {some_of(names)}: not used, as no panorama of the model is called so")
    return lines
