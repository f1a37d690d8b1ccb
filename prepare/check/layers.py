"""What the masks of a scene leave out, and files of its layers that belong to no panorama."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from panolog.prepare.networks.masks import share_of_sphere
from panolog.prepare.panorama_files import find_image_files
from panolog.prepare.provenance import read_mask
from panolog.scene.files import some_of
from panolog.scene.model import Scene
from panolog.scene.read import DEPTHS, MASKS, SKY_MASKS

_LOOKED_AT = 48  # masks, evenly chosen
_MOST = 0.5  # of the sphere that masks leave out, from which on they may be inverted
_BLACK = "black or transparent is what is ignored"


@dataclass(frozen=True)
class Layers:
    """What was found in the layers of a scene, one line each."""

    lines: tuple[str, ...]  # how much of the sphere the masks leave out, and files that match nothing
    problems: tuple[str, ...]  # what nothing can be trained with


def look_at_layers(scene: Scene) -> Layers:
    """What the masks of a scene leave out, and files in its layers that match nothing.

    Raises SceneError if a mask is damaged.
    """
    shares, masks = _masks(scene)
    blank = len(masks) > 0 and shares.min() == 1
    wrong = (f"masks: nothing is left of {len(shares)} panoramas that were looked at; {_BLACK}",)
    return Layers((*masks, *_unmatched(scene)), wrong if blank else ())


def _masks(scene: Scene) -> tuple[NDArray[np.float64], list[str]]:
    """The shares of the sphere that some masks leave out, and lines of them; both empty without masks."""
    masks = {panorama.name: panorama.mask for panorama in scene.panoramas if panorama.mask is not None}
    if not masks:
        return np.zeros(0), []
    chosen = np.unique(np.linspace(0, len(masks) - 1, min(_LOOKED_AT, len(masks))).astype(int))
    names = [list(masks)[row] for row in chosen]
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


def _unmatched(scene: Scene) -> list[str]:
    layers = {
        MASKS: {it.mask for it in scene.panoramas},
        SKY_MASKS: {it.sky_mask for it in scene.panoramas},
        DEPTHS: {it.depth for it in scene.panoramas},
    }
    lines = []
    for layer, used in layers.items():
        folder = scene.root / layer
        lost = [path for path in find_image_files(folder) if path not in used]
        names = [path.relative_to(folder).as_posix() for path in lost]
        if names:
            lines.append(f"{layer}: {some_of(names)}: not used, as no panorama of the model is called so")
    return lines
