"""`panolog scene stitch`: panoramas of a folder, or of one picture of two fisheye circles."""

from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from panolog.prepare.stitching.lenses import Pair, Up, read_pairs
from panolog.prepare.stitching.pictures import INSP, LENSES, raw_pictures, shows_circles, stitch_pictures
from panolog.scene.errors import SceneError
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
        found = [
            {"camera": it.camera, "size": list(it.size), "error_degrees": it.error} for it in self.lenses
        ]
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
    source: Path, output: Path, *, width: int | None, up: Up | None, progress: StageProgress
) -> StitchReport:
    """Stitches all pictures of two circles in a folder, or one; arguments and errors as `stitch_pictures`."""
    notes = list[str]()
    if source.is_dir():
        files, root = raw_pictures(source), source
    elif source.is_file():
        raw = source.suffix.lower() == INSP or shows_circles(source)
        files, root = [source] if raw else [], source.parent
    else:
        raise SceneError(f"{source}: there is no such file or folder")
    if not files:
        raise SceneError(
            f"{source}: shows no two fisheye circles next to each other; panoramas need no stitching"
        )
    if root.resolve() in (output.resolve(), *output.resolve().parents) and source.is_dir():
        raise SceneError(f"{output}: is inside {source}, whose pictures are read; give a folder elsewhere")
    show = partial(progress, "stitching")
    made = stitch_pictures(files, root, output, width=width, up=up, progress=show, note=notes.append)
    return StitchReport(output, len(made), read_pairs(output / LENSES), notes)
