"""The panoramas of the sources of a scene: chosen frames of videos, and photographs, stitched if need be.

Each source is looked at by itself. What is made of it is kept in the workspace, and used by a later call.
"""

import hashlib
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

from panolog.prepare.file_kinds import INSP, converted_here
from panolog.prepare.panorama_files import (
    SUFFIXES,
    PanoramaFile,
    look_into,
    masks_among,
    pictures_below,
)
from panolog.prepare.sources.convert import as_png
from panolog.prepare.sources.find import Source, Sources
from panolog.prepare.sources.sizes import to_one_size
from panolog.prepare.stitching.lenses import Up
from panolog.prepare.stitching.pictures import raw_pictures, stitch_pictures
from panolog.prepare.video.frames import FrameChoice, extract_frames
from panolog.prepare.world.cropped import complete_panoramas
from panolog.prepare.world.exif import read_exif
from panolog.scene.errors import SceneError
from panolog.scene.files import some_of
from panolog.scene.read import DEPTHS, MASKS, MIN_CAMERAS, SKY_MASKS, check_names, find_layer
from panolog.scene.write import Progress, StageProgress, part_of

_LAYERS = (MASKS, SKY_MASKS, DEPTHS)
Note = Callable[[str], None]


@dataclass(frozen=True)
class Gathered:
    """The panoramas of a scene."""

    panoramas: tuple[PanoramaFile, ...]  # of one size, in the order of capture
    left_out: tuple[str, ...]  # what of the sources was not read, one line for each kind
    notes: tuple[str, ...]  # what videos and raw files lack, and what was scaled


def gather(
    sources: Sources,
    work: Path,
    choice: FrameChoice,
    progress: StageProgress,
    known: Sequence[PanoramaFile] = (),
) -> Gathered:
    """The panoramas of all sources.

    Args: work, the workspace; known, panoramas of a scene that these are added to. They come first, and what
        is a copy of one is left out.

    Raises InputError if a source is wrong, or there is nothing else than copies of one panorama; OSError if a
    file cannot be read or written.
    """
    notes, left_out = list[str](), list(sources.left_out)
    videos = [it for it in sources.all if it.is_video]
    folders = [it for it in sources.all if not it.is_video]
    found = dict[Source, list[PanoramaFile]]()
    for turn, source in enumerate(videos):
        show = part_of(partial(progress, "frames"), turn, len(videos))
        found[source] = _frames(source, _place(work, source), choice, show, notes.append)
    for turn, source in enumerate(folders):
        show = part_of(partial(progress, "stitching"), turn, len(folders))
        folder, others = _stitched(source.path, _place(work, source), choice.up, show, notes.append)
        alone = len(sources.all) == 1 and not known
        own = panoramas_in_folder(folder, MIN_CAMERAS if alone else 1)
        found[source] = [_labelled(source, panorama) for panorama in own]
        left_out += others
    if folders:
        taken = [panorama for source in folders for panorama in found[source]]
        least = 1 if videos or known else MIN_CAMERAS
        show = partial(progress, "metadata")
        whole, copies = _completed(taken, known, least, work / "whole", show)
        left_out[:0] = copies
        found |= {source: [it for it in whole if it.source == source.label] for source in folders}
    if len(sources.all) > 1:
        found |= {source: _in_order(found[source]) for source in folders}
    panoramas = [*known, *(panorama for source in sources.all for panorama in found[source])]
    check_names(work, [panorama.name for panorama in panoramas])
    sized = to_one_size(panoramas, work / "sized", partial(progress, "sizes"), notes.append)
    return Gathered(sized, tuple(left_out), tuple(notes))


def _place(work: Path, source: Source) -> Path:
    """The folder for what is made of a source."""
    return work / "sources" / source.label if source.label else work


def _labelled(source: Source, panorama: PanoramaFile) -> PanoramaFile:
    """A panorama with the label of its source in its name."""
    name = f"{source.label}/{panorama.name}" if source.label else panorama.name
    return replace(panorama, name=name, source=source.label)


def _frames(
    source: Source, place: Path, choice: FrameChoice, progress: Progress, note: Note
) -> list[PanoramaFile]:
    """The chosen frames of a video."""
    folder = place / "frames"
    files = extract_frames(
        source.path,
        folder,
        parallax=choice.parallax,
        most=choice.frames,
        up=choice.up,
        progress=progress,
        note=note,
    )
    masks = find_layer(folder, MASKS, [file.name for file in files])
    return [
        _labelled(source, PanoramaFile(folder, file.name, file, layers={} if mask is None else {MASKS: mask}))
        for file, mask in zip(files, masks, strict=True)
    ]


def _stitched(
    folder: Path, place: Path, up: Up | None, progress: Progress, note: Note
) -> tuple[Path, list[str]]:
    """The folder with the panoramas of one whose pictures are not stitched; any other as it is.

    And a line for each kind of files in it that are left out.
    """
    given = pictures_below(folder)
    files = folder.glob("[!.]*") if given != folder else ()
    others = sorted(it.name for it in files if it.suffix.lower() in SUFFIXES)
    lines = [f"{some_of(others)}: left out, as pictures are taken from {given}"] if others else []
    pictures = raw_pictures(given)
    if not pictures:
        return folder, [*lines, *look_into(given, converted_here()).left_out]
    stitch_pictures(pictures, given, place / "stitched", up=up, progress=progress, note=note)
    return place / "stitched", [*lines, *look_into(given, {INSP}).left_out]


def _completed(
    panoramas: Sequence[PanoramaFile],
    known: Sequence[PanoramaFile],
    least: int,
    folder: Path,
    progress: Progress,
) -> tuple[tuple[PanoramaFile, ...], list[str]]:
    """Photographs without copies, also of those that are known, whole where they are cropped.

    And a line for each copy.
    """
    kept, lines = without_copies(panoramas, least, known)
    whole = as_png(kept, folder.with_name("converted"), part_of(progress, 0, 2))
    return complete_panoramas(whole, folder, part_of(progress, 1, 2)), lines


def _in_order(panoramas: Sequence[PanoramaFile]) -> list[PanoramaFile]:
    """Photographs in the order in which they were taken, if all say when; else of their names."""
    times = [read_exif(panorama.path).time for panorama in panoramas]
    known = [(time, place) for place, time in enumerate(times) if time is not None]
    all_known = len(known) == len(panoramas)
    return [panoramas[place] for _, place in sorted(known)] if all_known else list(panoramas)


def panoramas_in_folder(source: Path, least: int = MIN_CAMERAS) -> list[PanoramaFile]:
    """The panoramas in a folder, or in its folder images or imgs, with the layers next to or among them.

    A picture NAME_mask.png next to NAME.jpg is its mask.

    Raises SceneError: there is no such folder, it has fewer than `least` panoramas, or their names collide.
    """
    if not source.is_dir():
        raise SceneError(f"{source}: there is no such folder or video")
    inner = pictures_below(source)
    content = look_into(inner, converted_here())
    images = [path for path in content.images if path.relative_to(inner).parts[0] not in _LAYERS]
    among = masks_among(images)
    files = [path for path in images if path not in among.values()]
    if len(files) < least:
        reason = "; ".join([f"at least {least} are needed", *content.left_out])
        raise SceneError(f"{inner}: {len(files)} panoramas ({', '.join(sorted(SUFFIXES))}); {reason}")
    names = tuple(path.relative_to(inner).as_posix() for path in files)
    check_names(inner, names)
    is_root = inner != source or any((source / layer).is_dir() for layer in _LAYERS)
    root = source if is_root else source.parent
    layers = {layer: find_layer(root, layer, names) for layer in _LAYERS}
    layers[MASKS] = [mask or among.get(file) for mask, file in zip(layers[MASKS], files, strict=True)]
    found = list[PanoramaFile]()
    for row, (name, file) in enumerate(zip(names, files, strict=True)):
        own = {layer: path for layer, paths in layers.items() if (path := paths[row]) is not None}
        found.append(PanoramaFile(root, name, file, layers=own))
    return found


def without_copies(
    panoramas: Sequence[PanoramaFile], least: int = MIN_CAMERAS, known: Sequence[PanoramaFile] = ()
) -> tuple[list[PanoramaFile], list[str]]:
    """The panoramas whose files differ, and a line for each other one: it shows nothing more.

    Args: known, others that they are not to be copies of.
    Raises: SceneError, fewer than `least` differ.
    """
    every = [*known, *panoramas]
    sizes = Counter(panorama.path.stat().st_size for panorama in every)
    first, kept, lines = dict[bytes, str](), list[PanoramaFile](), list[str]()
    for place, panorama in enumerate(every, start=-len(known)):
        if sizes[panorama.path.stat().st_size] > 1:
            digest = hashlib.sha256(panorama.path.read_bytes()).digest()
            if digest in first and place >= 0:
                lines.append(f"{panorama.name}: is a copy of {first[digest]}, left out")
                continue
            first.setdefault(digest, panorama.name)
        if place >= 0:
            kept.append(panorama)
    if len(kept) < least:
        raise SceneError(
            f"{panoramas[0].root}: {len(kept)} panoramas differ, the others are copies; at least {least} "
            "are needed"
        )
    return kept, lines
