"""Masks of other programs' scenes, and what else such a scene has that an import leaves out.

COLMAP, SphereSfM, OpenSfM, nerfstudio, openMVG and Metashape agree on the values, black is ignored, and
differ in the names: masks/STEM.png, masks/NAME.png (COLMAP, OpenSfM), masks/STEM_mask.png (Metashape), or
NAME_mask.png next to the panorama (openMVG); nerfstudio's transforms.json names them.
"""

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path, PurePosixPath

from panolog.prepare.importers.interface import ENDINGS, ImportSource
from panolog.prepare.panorama_files import look_into
from panolog.scene.files import some_of, stem_of
from panolog.scene.image_files import check_layer
from panolog.scene.write import PosedImage

_MASKS = ("masks", "mask", "opensfm/masks")
_LEFT_OUT = {
    "depths": "`panolog scene depth` makes depth maps",
    "depth": "`panolog scene depth` makes depth maps",
    "skymasks": "`panolog scene depth` makes sky masks",
    "segmentations": "make masks of them, black = ignore",
    "semantics": "make masks of them, black = ignore",
    "offset.json": "copy it to SCENE, if the world was not moved, to keep its place on the earth",
}
_ENDS = tuple(dict.fromkeys((".png", ".PNG", *ENDINGS)))  # the likeliest first


def find_masks(
    source: ImportSource, images: Sequence[PosedImage], named: Mapping[str, Path]
) -> tuple[list[Path | None], list[str]]:
    """(the mask of each image, one line for each kind of file that is left out).

    Args: named, masks that the format itself names, by the names of the images.
    Raises SceneError if a mask is damaged or not 2:1.
    """
    roots = list(dict.fromkeys(_root(image) for image in images))
    places = dict.fromkeys([source.folder, *(root.parent for root in roots if root != source.folder)])
    folders = [place / name for place in places for name in _MASKS if (place / name).is_dir()]
    stems = [PurePosixPath(stem_of(image.name)).name for image in images]
    shared = Counter(stems)
    found = [
        named.get(image.name) or _mask_of(image, folders, alone=shared[stem] == 1)
        for image, stem in zip(images, stems, strict=True)
    ]
    check_layer(found, bits=8)
    notes = []
    if count := len([mask for mask in found if mask]):
        notes.append(f"{count} of {len(images)} panoramas have a mask in the source: it is in SCENE/masks")
    used = {mask.resolve() for mask in found if mask}
    for folder in folders:
        if lost := [it.name for it in look_into(folder).images if it.resolve() not in used]:
            notes.append(f"{folder}: {some_of(lost)}: left out, as masks of no panorama")
    notes += [
        f"{root / 'mask.png'}: left out; if black in it is to be ignored in all panoramas, "
        "copy it to SCENE/masks/STEM.png"
        for root in roots
        if (root / "mask.png").is_file() and (root / "mask.png").resolve() not in used
    ]
    for place in places:
        notes += [
            f"{place / it}: left out; {what}" for it, what in _LEFT_OUT.items() if (place / it).exists()
        ]
    return found, notes


def _root(image: PosedImage) -> Path:
    """The folder that an image's name is relative to."""
    return image.file.parents[len(PurePosixPath(image.name).parts) - 1]


def _mask_of(image: PosedImage, folders: Sequence[Path], *, alone: bool) -> Path | None:
    """The mask of an image in one of the folders, or next to it.

    Args: alone, no image in another folder has its name, so that its mask needs no folder.
    """
    for folder in folders:
        for name in (image.name, *([PurePosixPath(image.name).name] if alone else [])):
            for spelling in _spellings(name, ("", "_mask")):
                if (folder / spelling).is_file():
                    return folder / spelling
    near = (image.file.parent / name for name in _spellings(image.file.name, ("_mask",)))
    return next((path for path in near if path.is_file()), None)


def _spellings(name: str, marks: Sequence[str]) -> Iterator[str]:
    """What programs call the mask of a panorama. Args: marks, what follows its name."""
    for mark in marks:
        for end in _ENDS:
            yield f"{stem_of(name)}{mark}{end}"
            yield f"{name}{mark}{end}"
