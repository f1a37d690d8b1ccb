"""`panolog scene stitch`: panoramas of pictures or a video of two fisheye circles."""

from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from panolog.prepare.file_kinds import INSP
from panolog.prepare.panorama_files import SUFFIXES, pictures_below
from panolog.prepare.stitching.lenses import Pair, pairs_as_json, read_pairs
from panolog.prepare.stitching.pictures import (
    LENSES,
    check_folder,
    find_pairs,
    raw_pictures,
    shows_circles,
    stitch_pictures,
)
from panolog.prepare.video.frames import FrameChoice, extract_frames
from panolog.prepare.video.lenses import video_lenses
from panolog.scene.errors import ConfigError, SceneError
from panolog.scene.files import write_bytes
from panolog.scene.write import StageProgress


@dataclass(frozen=True)
class StitchReport:
    """What was stitched."""

    output: Path
    panoramas: int
    lenses: list[Pair]  # of each camera
    notes: list[str]  # what is doubtful

    def as_json(self) -> dict[str, Any]:
        """What `panolog scene stitch --json` prints."""
        found = [{"camera": it.camera, "size": it.size, "error_degrees": it.error} for it in self.lenses]
        return {
            "output": str(self.output),
            "panoramas": self.panoramas,
            "lenses": found,
            "notes": self.notes,
        }

    def lines(self) -> list[str]:
        """For people."""
        fits = [
            f"{it.camera or 'the camera'}: its lenses agree within {it.error:.2f}° in the median"
            for it in self.lenses
        ]
        return [f"{self.output}: {self.panoramas} panoramas", *fits, *self.notes]


def stitch_source(
    source: Path,
    output: Path,
    *,
    width: int | None,
    choice: FrameChoice,
    progress: StageProgress,
) -> StitchReport:
    """Stitches the pictures of two circles in a folder, one picture, or a video.

    Arguments and errors as of `stitch_pictures` and `extract_frames`.
    """
    up = choice.up
    if not source.exists():
        raise SceneError(f"{source}: there is no such file or folder")
    if source.is_dir() and output.resolve().is_relative_to(source.resolve()):
        raise SceneError(f"{output}: is inside {source}, whose pictures are read; give a folder elsewhere")
    notes = list[str]()
    if source.is_file() and source.suffix.lower() not in {INSP, *SUFFIXES}:
        if width is not None:
            raise ConfigError("--width is of pictures; frames of a video are as wide as the lenses resolve")
        if (lenses := video_lenses(source)) is None:
            raise _no_circles(source)
        pair = lenses.pair
        check_folder(output)
        output.mkdir(parents=True, exist_ok=True)
        write_bytes(output / LENSES, pairs_as_json([pair if up is None else replace(pair, up=up)]))
        made = extract_frames(
            source,
            output,
            parallax=choice.parallax,
            most=choice.frames,
            up=up,
            progress=partial(progress, "frames"),
            note=notes.append,
        )
    else:
        if source.is_dir():
            files, root = raw_pictures(source), source
        else:
            raw = source.suffix.lower() == INSP or shows_circles(source)
            files, root = [source] if raw else [], source.parent
        if not files:
            raise _no_circles(source)
        show = partial(progress, "stitching")
        made = stitch_pictures(files, root, output, width=width, up=up, progress=show, note=notes.append)
    return StitchReport(output, len(made), read_pairs(output / LENSES), notes)


def look_at_raw(source: Path) -> tuple[int, int] | None:
    """How many pictures of a folder are to be stitched, and the width of their panoramas; None if none is.

    Raises as `stitch_pictures` does.
    """
    inner = pictures_below(source)
    files = raw_pictures(inner) if inner.is_dir() else []
    return (len(files), min(pair.width for pair in find_pairs(files).values())) if files else None


def _no_circles(source: Path) -> SceneError:
    return SceneError(
        f"{source}: shows no two fisheye circles next to each other; panoramas need no stitching"
    )
