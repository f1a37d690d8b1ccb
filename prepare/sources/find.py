"""Which videos and folders of panoramas a scene is made of, how they are called, and in which order.

The order is that of capture: by the time that a camera has written into the file, else by that of the file.
GoPro divides a recording into chapters that share its number, GH010042, GH020042, …: they stay together.
"""

import re
from collections import Counter
from collections.abc import Collection, Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

import av

from panolog.prepare.file_kinds import INSP, VIDEOS, converted_here
from panolog.prepare.panorama_files import look_into, pictures_below
from panolog.prepare.video.lenses import first_lens
from panolog.prepare.video.streams import begun, open_container
from panolog.prepare.world.exif import read_exif
from panolog.scene.errors import SceneError
from panolog.scene.files import natural_key, some_of
from panolog.scene.read import refuse_run

_CHAPTER = re.compile(r"G(?:OPR|[HXSP](\d\d))(\d{4})", re.IGNORECASE)
_PREVIEW = "LRV_"  # in front of the name of a small copy of a video, by Insta360


@dataclass(frozen=True)
class Source:
    """A video, or a folder of panoramas."""

    path: Path
    label: str  # the folder of its panoramas in the scene; empty if it is the only source
    is_video: bool


@dataclass(frozen=True)
class Sources:
    """All that a scene is made of."""

    all: tuple[Source, ...]  # in the order of capture
    left_out: tuple[str, ...]  # of folders of videos, one line for each kind of files


def find_sources(given: Sequence[Path], taken: Collection[str] = ()) -> Sources:
    """The videos and folders of panoramas that are given, and the videos in folders without pictures.

    Each has a label of its own: the name of its file or folder, after those above where names are equal.
    Args: taken, labels of the scene that they are added to, if there is one.

    Raises SceneError: a file or folder is missing, given twice, or that of a run.
    """
    found, left_out = list[Source](), list[str]()
    for path in given:
        if not path.exists():
            raise SceneError(f"{path}: there is no such folder or video")
        refuse_run(path)
        content = look_into(path, VIDEOS) if path.is_dir() else None
        if content is None or (content.videos and not _pictures(path)):
            found += [Source(it, "", is_video=True) for it in ([path] if content is None else content.videos)]
            left_out += [] if content is None else content.left_out
        else:
            found.append(Source(path, "", is_video=False))
    if len(found) > 1:
        found, previews = _without_companions(found)
        left_out += previews
    twice = [path for path, count in Counter(it.path.resolve() for it in found).items() if count > 1]
    if twice:
        raise SceneError(f"{twice[0]}: is given twice; give each video and each folder once")
    if len(found) > 1 or taken:
        labels = _labels([it.path.resolve() for it in found], taken)
        found = [replace(it, label=label) for it, label in zip(found, labels, strict=True)]
    return Sources(tuple(_in_order(found)), tuple(left_out))


def _pictures(folder: Path) -> list[Path]:
    """The pictures of a folder, also those of two lenses, in the natural order of their names."""
    return look_into(pictures_below(folder), {*converted_here(), INSP}).images


def _without_companions(sources: Sequence[Source]) -> tuple[list[Source], list[str]]:
    """The sources without the files of second lenses, which go with those of the first, and without previews.

    And a line about previews.
    """
    paths = {it.path.resolve() for it in sources}
    previews = [it.path.name for it in sources if it.is_video and it.path.name.startswith(_PREVIEW)]
    lines = [f"{some_of(previews)}: left out, as small copies of videos are"] if previews else []
    kept = [
        it
        for it in sources
        if not (it.is_video and (it.path.name in previews or first_lens(it.path.resolve()) in paths))
    ]
    return kept, lines


def _labels(paths: Sequence[Path], taken: Collection[str]) -> list[str]:
    """A label for each resolved path, of letters, digits, - and _, all different and none that is taken."""
    depths = [1] * len(paths)
    while True:
        labels = [_label(path, depth) for path, depth in zip(paths, depths, strict=True)]
        alike = {label for label, count in Counter(labels).items() if count > 1}.union(taken)
        deeper = [
            depth + (label in alike and depth < len(path.parts))
            for path, depth, label in zip(paths, depths, labels, strict=True)
        ]
        if deeper == depths:
            return list(_numbered(labels, taken))
        depths = deeper


def _label(path: Path, depth: int) -> str:
    """The names of so many of the last parts of a path, of a file without its suffix."""
    parts = [*path.parts[:-1], path.stem if path.is_file() else path.name][-depth:]
    return "-".join("".join(it if it.isalnum() or it in "-_" else "_" for it in part) for part in parts)


def _numbered(labels: Iterable[str], taken: Iterable[str]) -> Iterable[str]:
    """Labels of which the second of the same name ends in -2."""
    used = set(taken)
    for label in labels:
        number, new = 1, label
        while new in used:
            number += 1
            new = f"{label}-{number}"
        used.add(new)
        yield new


def _in_order(sources: Sequence[Source]) -> list[Source]:
    """The sources in the order of capture."""
    times = {it.path: _begun(it) for it in sources}
    first = dict[tuple[str, str], datetime]()
    for it in sources:
        recording, _ = _chapter(it.path)
        first[recording] = min(times[it.path], first.get(recording, datetime.max))

    def key(source: Source) -> Any:
        recording, chapter = _chapter(source.path)
        return first[recording], natural_key(recording[0]), recording, chapter

    return sorted(sources, key=key)


def _chapter(path: Path) -> tuple[tuple[str, str], int]:
    """The recording that a file is of, and which of its chapters."""
    named = _CHAPTER.fullmatch(path.stem)
    if named is None:
        return (path.as_posix(), ""), 0
    return (path.parent.as_posix(), named[2]), int(named[1] or 0)


def _begun(source: Source) -> datetime:
    """When a source begins, by the clock of its camera or, without one, of its file."""
    file = source.path
    if source.is_video:
        with suppress(av.FFmpegError, UnicodeError), open_container(file) as container:  # refused later
            if (time := begun(container)) is not None:
                return time.replace(tzinfo=None)
    else:
        file = next(iter(_pictures(source.path)), source.path)
        if file.is_file() and (taken := read_exif(file).time) is not None:
            return taken
    return datetime.fromtimestamp(file.stat().st_mtime, timezone.utc).replace(tzinfo=None)
