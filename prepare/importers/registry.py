"""Which formats there are, and which of them a file or folder is."""

from collections.abc import Callable
from dataclasses import dataclass

from panolog.prepare.importers import (
    egonerf,
    metashape,
    nerfstudio,
    omniblender,
    omnigs,
    openmvg,
    opensfm,
    panorama_sfm,
    roam360,
    spheresfm,
)
from panolog.prepare.importers.interface import ImportedScene, ImportSource
from panolog.prepare.importers.raw_colmap import model_folder, read_cameras
from panolog.scene.errors import InputError


@dataclass(frozen=True)
class Format:
    """One format: `detect` looks at names and first bytes only, `read` reads all."""

    what: str
    detect: Callable[[ImportSource], bool]
    read: Callable[[ImportSource], ImportedScene]


FORMATS = {
    "openmvg": Format("openMVG's sfm_data.json, also as OmniGS reads it", openmvg.detect, openmvg.read),
    "omnigs": Format("the keyframes JSON (cameras.json) of OmniGS", omnigs.detect, omnigs.read),
    "opensfm": Format("OpenSfM's reconstruction.json", opensfm.detect, opensfm.read),
    "nerfstudio": Format("nerfstudio's transforms.json", nerfstudio.detect, nerfstudio.read),
    "360roam": Format("360Roam, as published or as prepared for ODGS", roam360.detect, roam360.read),
    "egonerf": Format("Ricoh360 in EgoNeRF's layout", egonerf.detect, egonerf.read),
    "omniblender": Format("OmniBlender in EgoNeRF's layout", omniblender.detect, omniblender.read),
    "panorama_sfm": Format(
        "COLMAP models of perspective faces by pycolmap's panorama_sfm",
        panorama_sfm.detect,
        panorama_sfm.read,
    ),
    "spheresfm": Format(
        "COLMAP models of panoramas: SphereSfM's SPHERE, EQUIRECTANGULAR", spheresfm.detect, spheresfm.read
    ),
    "metashape": Format("Metashape's camera XML", metashape.detect, metashape.read),
}


def choose(source: ImportSource, name: str | None) -> str:
    """The format: `name` if it is given, else the only one that knows the source.

    Raises:
        InputError: there is no such format or source, or none or several know it.
    """
    if name is not None and name not in FORMATS:
        raise InputError(f"--format {name}: there is no such format; one of {', '.join(FORMATS)}")
    for path, option in ((source.path, ""), (source.images, "--images "), (source.points, "--points ")):
        if path is not None and not path.exists():
            raise InputError(f"{option}{path}: there is no such file or folder")
    if name is not None:
        return name
    found = [key for key, kind in FORMATS.items() if kind.detect(source)]
    if not found and (folder := model_folder(source.path)) is not None:
        read_cameras(folder)  # says what is wrong with a COLMAP model that nobody wants
    if len(found) != 1:
        what = f"could be {' or '.join(found)}" if found else "is of no format that can be imported"
        raise InputError(f"{source.path}: {what}; say which with --format ({', '.join(FORMATS)})")
    return found[0]
