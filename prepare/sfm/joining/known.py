"""The scene that panoramas are added to, and what its points become with them."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from panolog.prepare.networks.masks import GIVEN
from panolog.prepare.panorama_files import PanoramaFile
from panolog.prepare.sfm.sparse_model import SparseModel
from panolog.scene.colmap import read_colmap
from panolog.scene.model import NO_OFFSET, Scene
from panolog.scene.read import DEPTHS, MASKS, SKY_MASKS, model_folder, read_scene
from panolog.scene.write import UNSEEN, Offset, PosedImage, Sightings, read_offset

_SAME = 0.5  # pixels between a feature and an observation of the scene: of the same detector they are equal
_NOWHERE = -1


@dataclass(frozen=True, eq=False)
class KnownScene:
    """A finished scene, as training reads it."""

    scene: Scene
    images: tuple[PosedImage, ...]  # with what they have observed
    panoramas: tuple[PanoramaFile, ...]  # with the masks of a user that were combined with others, too
    offset: Offset | None
    split: Mapping[str, list[str]] | None  # as train.txt and test.txt have it


def read_known(folder: Path) -> KnownScene:
    """Reads a scene that panoramas are to be added to. Raises SceneError as `read_scene` does."""
    scene = read_scene(folder)
    tracks = {image.name: image for image in read_colmap(model_folder(scene.root)).images}
    images, panoramas = list[PosedImage](), list[PanoramaFile]()
    for panorama in scene.panoramas:
        image = tracks[panorama.name]
        where = image.pixels / (image.camera.width, image.camera.height)
        images.append(
            PosedImage(
                panorama.name,
                panorama.image,
                panorama.rotation,
                panorama.translation,
                (image.points, where),
                image.quaternion,
            )
        )
        file = PanoramaFile(scene.root, panorama.name, panorama.image, scene.root.name)
        given = it if (it := file.layer(GIVEN)).is_file() else None
        layers = {MASKS: panorama.mask, SKY_MASKS: panorama.sky_mask, DEPTHS: panorama.depth, GIVEN: given}
        panoramas.append(replace(file, layers={name: path for name, path in layers.items() if path}))
    offset = read_offset(scene.root)
    if scene.offset != NO_OFFSET:  # the model is far from its origin: what is read of it is not
        there = np.add(scene.offset, NO_OFFSET if offset is None else offset.offset)
        offset = (offset or Offset(offset=NO_OFFSET)).model_copy(update={"offset": tuple(there.tolist())})
    split = None
    if any((scene.root / name).is_file() for name in ("train.txt", "test.txt")):
        parts = {"train.txt": scene.train, "test.txt": scene.test}
        split = {name: [scene.panoramas[row].stem for row in rows] for name, rows in parts.items()}
    return KnownScene(scene, tuple(images), tuple(panoramas), offset, split)


def with_new(known: KnownScene, found: SparseModel, size: tuple[int, int], most: float) -> SparseModel:
    """The scene with the panoramas of `found` that it does not have, and the points that these see.

    Its own poses and points are those that it has; a point that is found again is not new.
    Args: found, in the scene's world, whose first panoramas are the scene's; size, (width, height) in
        pixels; most, pixels that an observation may be off.
    """
    count, points = len(known.images), known.scene.points
    old_of = _found_again(known, found, size)
    seen_by_new = np.zeros(len(found.points), np.bool_)
    for rows, _ in found.sightings[count:]:
        seen_by_new[rows] = True
    new = np.flatnonzero(seen_by_new & (old_of == _NOWHERE))
    row_of = old_of.copy()
    row_of[new] = len(points) + np.arange(len(new))
    sightings = list[Sightings]()
    for place, (rows, where) in enumerate(found.sightings):
        given = known.images[place].sightings if place < count else UNSEEN
        fresh = row_of[rows] >= (len(points) if place < count else 0)
        sightings.append(
            (np.concatenate([given[0], row_of[rows[fresh]]]), np.concatenate([given[1], where[fresh]]))
        )
    model = SparseModel(
        found.rows,
        np.concatenate([np.stack([it.rotation for it in known.images]), found.rotations[count:]]),
        np.concatenate([np.stack([it.translation for it in known.images]), found.translations[count:]]),
        np.concatenate([points, found.points[new]]),
        tuple(sightings),
    )
    return _within(model, count, size[0], most)


def _found_again(known: KnownScene, found: SparseModel, size: tuple[int, int]) -> NDArray[np.int64]:
    """(P,) the scene's point that each point of `found` is, by where the scene's panoramas observe it."""
    old_of = np.full(len(found.points), _NOWHERE)
    for image, (rows, where) in zip(known.images, found.sightings, strict=False):
        points, there = image.sightings
        if len(points) and len(rows):
            apart, nearest = cKDTree(there * size).query(where * size)
            same = apart <= _SAME
            old_of[rows[same]] = points[nearest[same]]
    return old_of


def _within(model: SparseModel, count: int, width: int, most: float) -> SparseModel:
    """The model without observations of panoramas from `count` on that are more than `most` pixels off."""
    sightings = list(model.sightings)
    for place, off in enumerate(model.errors(width)[count:], start=count):
        rows, where = sightings[place]
        sightings[place] = rows[off <= most], where[off <= most]
    return SparseModel(model.rows, model.rotations, model.translations, model.points, tuple(sightings))
