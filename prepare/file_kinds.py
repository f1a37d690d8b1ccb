"""Files of cameras that are not read, by the ends of their names: what they are, and what to do with them."""

from collections import defaultdict
from collections.abc import Iterable
from pathlib import Path

from panolog.scene.errors import command_for, installed
from panolog.scene.files import some_of
from panolog.scene.pictures.kinds import STITCH

_RAW = (
    "a camera's raw data; develop all alike to TIFF or JPEG, such as with darktable; the program of a 360° "
    "camera stitches them too"
)
_HEIC = f"HEIC; {command_for('pi_heif')} reads it; or convert it: `heif-convert NAME.heic NAME.jpg`"
_NAMED = "a JPEG; rename it to NAME.jpg"
_PACKED = "an archive; unpack it, and give the folder"
_LIGHT = "a picture of high dynamic range; save it tone-mapped, as TIFF or PNG of 8 or 16 bits"
_LENSES = f"a video of two lenses; {STITCH}"
_VIDEO = "a video; give it by itself, or next to the folder: `panolog run FOLDER VIDEO -o RUN`"
_STITCHED = (".mp4", ".mov", ".m4v", ".mkv", ".webm", ".avi")
HEIC, AVIF = (".heic", ".heif", ".hif"), (".avif",)  # pictures that become PNG: `sources/convert.py`
INSP = ".insp"  # a JPEG that Insta360 names so where it is not stitched
VIDEOS = frozenset({*_STITCHED, ".insv", ".osv"})  # that a folder may hold
_KINDS = {
    INSP: f"a photograph of two fisheye lenses (Insta360); {STITCH}",
    ".insv": _LENSES,
    ".360": _LENSES,
    ".osv": _LENSES,
    **dict.fromkeys((".dng", ".cr2", ".cr3", ".nef", ".arw", ".raf", ".rw2", ".gpr"), _RAW),
    **dict.fromkeys(HEIC, _HEIC),
    **dict.fromkeys((".jfif", ".jpe", ".jfi", ".mpo"), _NAMED),
    **dict.fromkeys((".jp2", ".j2k"), "JPEG 2000; save it as PNG or TIFF"),
    **dict.fromkeys(AVIF, "AVIF; convert it with `avifdec NAME.avif NAME.png`"),
    ".jxl": "JPEG XL; convert it with `djxl NAME.jxl NAME.png`",
    **dict.fromkeys((".zip", ".7z", ".rar", ".tar", ".gz", ".tgz"), _PACKED),
    **dict.fromkeys((".exr", ".hdr"), _LIGHT),
    **dict.fromkeys((".psd", ".psb", ".xcf"), "a file of an editor; export it as TIFF or PNG"),
    **dict.fromkeys(_STITCHED, _VIDEO),
}


def converted_here() -> frozenset[str]:
    """The ends of names of pictures that become PNG, of which what decodes them is installed."""
    return frozenset({*AVIF, *(HEIC if installed("pi_heif") else ())})


def describe_file(path: Path) -> str | None:
    """What a file is and what to do with it, if it is of a kind that is not read; else None."""
    return _KINDS.get(path.suffix.lower())


def describe_left_out(files: Iterable[Path], folder: Path) -> list[str]:
    """One line for each kind of files below a folder that are left out: how many, their names, what to do."""
    kinds = defaultdict[str, list[str]](list)
    for path in files:
        if (what := describe_file(path)) is not None:
            kinds[what].append(path.relative_to(folder).as_posix())
    return [f"{some_of(names)}: left out, each {what}" for what, names in kinds.items()]
