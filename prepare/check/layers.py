"""What the masks of a scene leave out, and files of its layers that belong to no panorama."""

import numpy as np

from panolog.prepare.networks.masks import share_of_sphere
from panolog.prepare.panorama_files import find_image_files
from panolog.prepare.provenance import read_mask
from panolog.scene.files import some_of
from panolog.scene.model import Scene
from panolog.scene.read import DEPTHS, MASKS, SKY_MASKS

_LOOKED_AT = 12  # masks, evenly chosen
_MOST = 0.5  # of the sphere that masks leave out, from which on they may be inverted


def describe_layers(scene: Scene) -> list[str]:
    """One line each: how much of the sphere the masks leave out, and files in layers that match nothing.

    Raises SceneError if a mask is damaged.
    """
    return [*_masks(scene), *_unmatched(scene)]


def _masks(scene: Scene) -> list[str]:
    masks = [panorama.mask for panorama in scene.panoramas if panorama.mask is not None]
    if not masks:
        return []
    chosen = np.unique(np.linspace(0, len(masks) - 1, min(_LOOKED_AT, len(masks))).astype(int))
    shares = [share_of_sphere(~read_mask(masks[row])) for row in chosen]
    mean = float(np.mean(shares))
    line = (
        f"masks: {len(masks)} of {len(scene.panoramas)} panoramas have one, and {mean:.1%} of the sphere is "
        f"ignored ({min(shares):.1%} to {max(shares):.1%})"
    )
    if mean == 0:
        line += "; nothing is: black or transparent is what is ignored"
    elif mean > _MOST:
        line += (
            "; that is most of it: black or transparent is what is ignored, invert them if it is to be used"
        )
    return [line]


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
