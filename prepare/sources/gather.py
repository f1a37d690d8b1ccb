"""The panoramas of the sources of a scene: chosen frames of videos, and photographs, stitched if need be.

Each source is looked at by itself. What is made of it is kept in the workspace, and used by a later call.
"""

import hashlib
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Protocol

from panolog.prepare.file_kinds import converted_here
from panolog.prepare.panorama_files import (
    SUFFIXES,
    LayerFiles,
    PanoramaFile,
    look_into,
    masks_among,
    pictures_below,
)
from panolog.prepare.sources.convert import as_png
from panolog.prepare.sources.find import Source, Sources
from panolog.prepare.sources.sizes import to_one_size
from panolog.prepare.stitching.lenses import Up
from panolog.prepare.stitching.pictures import INSP, raw_pictures, stitch_pictures
from panolog.prepare.video.frames import extract_frames
from panolog.prepare.world.cropped import complete_panoramas
from panolog.prepare.world.exif import read_exif
from panolog.scene.errors import SceneError
from panolog.scene.files import some_of
from panolog.scene.read import DEPTHS, MASKS, MIN_CAMERAS, SKY_MASKS, check_names, find_layer
from panolog.scene.write import Progress, StageProgress, part_of

_LAYERS = (MASKS, SKY_MASKS, DEPTHS)
Note = Callable[[str], None]


class Choice(Protocol):
    """What is chosen of videos, and how raw files are stitched."""

    @property
    def parallax(self) -> float:
        """Degrees between two frames of a video."""

    @property
    def frames(self) -> int | None:
        """How many of each video at most."""

    @property
    def up(self) -> Up | None:
        """Where up is in the first circle of what is to be stitched."""


@dataclass(frozen=True)
class Gathered:
    """The panoramas of a scene."""

    panoramas: tuple[PanoramaFile, ...]  # of one size, in the order of capture
    layers: LayerFiles
    left_out: tuple[str, ...]  # what of the sources was not read, one line for each kind
    notes: tuple[str, ...]  # what videos and raw files lack, and what was scaled


@dataclass(frozen=True)
class Row:
    """A panorama with its layers."""

    panorama: PanoramaFile
    layers: dict[str, Path | None]


def gather(
    sources: Sources,
    work: Path,
    choice: Choice,
    progress: StageProgress,
    known: tuple[Sequence[PanoramaFile], LayerFiles] = ((), {}),
) -> Gathered:
    """The panoramas of all sources.

    Args: work, the workspace; known, panoramas of a scene that these are added to, with their layers. They
        come first, and what is a copy of one is left out.

    Raises InputError if a source is wrong, or there is nothing else than copies of one panorama; OSError if a
    file cannot be read or written.
    """
    notes, left_out = list[str](), list(sources.left_out)
    videos = [it for it in sources.all if it.is_video]
    folders = [it for it in sources.all if not it.is_video]
    rows = dict[Source, list[Row]]()
    for turn, source in enumerate(videos):
        show = part_of(partial(progress, "frames"), turn, len(videos))
        rows[source] = _frames(source, _place(work, source), choice, show, notes.append)
    for turn, source in enumerate(folders):
        show = part_of(partial(progress, "stitching"), turn, len(folders))
        folder, others = _stitched(source.path, _place(work, source), choice.up, show, notes.append)
        alone = len(sources.all) == 1 and not known[0]
        rows[source] = _photographs(source, folder, MIN_CAMERAS if alone else 1)
        left_out += others
    if folders:
        taken = [row for source in folders for row in rows[source]]
        least = 1 if videos or known[0] else MIN_CAMERAS
        show = partial(progress, "metadata")
        whole, copies = _completed(taken, known[0], least, work / "whole", show)
        left_out[:0] = copies
        rows |= {source: [it for it in whole if it.panorama.source == source.label] for source in folders}
    if len(sources.all) > 1:
        rows |= {source: _in_order(rows[source]) for source in folders}
    found = rows_of(*known) + [row for source in sources.all for row in rows[source]]
    panoramas = [row.panorama for row in found]
    check_names(work, [panorama.name for panorama in panoramas])
    sized = to_one_size(panoramas, work / "sized", partial(progress, "sizes"), notes.append)
    layers = {layer: [row.layers.get(layer) for row in found] for layer in _LAYERS}
    return Gathered(sized, layers, tuple(left_out), tuple(notes))


def _place(work: Path, source: Source) -> Path:
    """The folder for what is made of a source."""
    return work / "sources" / source.label if source.label else work


def _labelled(source: Source, panorama: PanoramaFile) -> PanoramaFile:
    """A panorama with the label of its source in its name."""
    name = f"{source.label}/{panorama.name}" if source.label else panorama.name
    return replace(panorama, name=name, source=source.label)


def _frames(source: Source, place: Path, choice: Choice, progress: Progress, note: Note) -> list[Row]:
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
        Row(_labelled(source, PanoramaFile(folder, file.name, file)), {MASKS: mask})
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


def _photographs(source: Source, folder: Path, least: int) -> list[Row]:
    """The panoramas of a source that is a folder. Args: folder, where they are."""
    panoramas, layers = panoramas_in_folder(folder, least)
    return rows_of([_labelled(source, panorama) for panorama in panoramas], layers)


def rows_of(panoramas: Sequence[PanoramaFile], layers: LayerFiles) -> list[Row]:
    """Panoramas, each with its layers."""
    return [
        Row(panorama, {layer: files[row] for layer, files in layers.items()})
        for row, panorama in enumerate(panoramas)
    ]


def _completed(
    rows: Sequence[Row], known: Sequence[PanoramaFile], least: int, folder: Path, progress: Progress
) -> tuple[list[Row], list[str]]:
    """Photographs without copies, also of those that are known, whole where they are cropped.

    And a line for each copy.
    """
    kept, lines = without_copies(rows, least, known)
    panoramas = [row.panorama for row in kept]
    whole = as_png(panoramas, folder.with_name("converted"), part_of(progress, 0, 2))
    whole = complete_panoramas(whole, folder, part_of(progress, 1, 2))
    return [replace(row, panorama=panorama) for row, panorama in zip(kept, whole, strict=True)], lines


def _in_order(rows: Sequence[Row]) -> list[Row]:
    """Photographs in the order in which they were taken, if all say when; else of their names."""
    times = [read_exif(row.panorama.path).time for row in rows]
    known = [(time, place) for place, time in enumerate(times) if time is not None]
    return [rows[place] for _, place in sorted(known)] if len(known) == len(rows) else list(rows)


def panoramas_in_folder(
    source: Path, least: int = MIN_CAMERAS
) -> tuple[tuple[PanoramaFile, ...], LayerFiles]:
    """The panoramas in a folder, or in its folder images or imgs, and the layers next to or among them.

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
    return tuple(PanoramaFile(root, name, file) for name, file in zip(names, files, strict=True)), layers


def without_copies(
    rows: Sequence[Row], least: int = MIN_CAMERAS, known: Sequence[PanoramaFile] = ()
) -> tuple[list[Row], list[str]]:
    """The panoramas whose files differ, and a line for each other one: it shows nothing more.

    Args: known, others that they are not to be copies of.
    Raises: SceneError, fewer than `least` differ.
    """
    every = [*known, *(row.panorama for row in rows)]
    sizes = Counter(panorama.path.stat().st_size for panorama in every)
    first, kept, lines = dict[bytes, str](), list[Row](), list[str]()
    for place, panorama in enumerate(every, start=-len(known)):
        if sizes[panorama.path.stat().st_size] > 1:
            digest = hashlib.sha256(panorama.path.read_bytes()).digest()
            if digest in first and place >= 0:
                lines.append(f"{panorama.name}: is a copy of {first[digest]}, left out")
                continue
            first.setdefault(digest, panorama.name)
        if place >= 0:
            kept.append(rows[place])
    if len(kept) < least:
        raise SceneError(
            f"{rows[0].panorama.root}: {len(kept)} panoramas differ, the others are copies; at least {least} "
            "are needed"
        )
    return kept, lines
