"""nerfstudio's transforms.json with the camera model EQUIRECTANGULAR.

`transform_matrix` is camera-to-world; camera x right, y up, z backward (OpenGL; right-handed), so longitude
0, the middle column, is -z. Pixel centres are at +0.5. World units and axes are those of the file: poses and
the cloud of `ply_file_path` share them, and `applied_transform`, which says how both came from another world,
is not undone. Source: nerfstudio's docs/quickstart/data_conventions.md and EQUIRECTANGULAR in
cameras/cameras.py.

The names in the scene are `file_path` without the folder that all of them have in common. Absolute paths may
be mixed with relative ones only if they lead into the folder of the file.
"""

from collections.abc import Sequence
from itertools import takewhile
from pathlib import Path, PurePosixPath

from panolog.prepare.importers.interface import ImportedScene, ImportSource, posed_image
from panolog.prepare.importers.json_xml import JsonNode, load_json
from panolog.prepare.importers.point_cloud import read_point_cloud
from panolog.prepare.importers.poses import FLIP_YZ
from panolog.scene.files import stem_of

FILES = ("transforms.json",)


def detect(source: ImportSource) -> bool:
    """Whether this is a transforms.json or a folder with one."""
    head = source.json_head(*FILES)
    return head.startswith(b"{") and b'"transform_matrix"' in head and b'"camera_model"' in head


def read(source: ImportSource) -> ImportedScene:
    """Reads the scene; see `interface`."""
    path = source.json_file(*FILES)
    content = load_json(path, source.memory)
    frames = list(content["frames"])
    for frame in frames:
        _check_camera(frame, content)
    names = [_name(frame["file_path"], path.parent) for frame in frames]
    absolute = [PurePosixPath(name).is_absolute() for name in names]
    if any(absolute) and not all(absolute):
        raise frames[absolute.index(True)]["file_path"].error(
            "is absolute where others are relative, and leads elsewhere; make it relative to the file"
        )
    parents = [PurePosixPath(name).parent.parts for name in names]
    shared = takewhile(lambda parts: len(set(parts)) == 1, zip(*parents, strict=False))
    common = str(PurePosixPath(*(parts[0] for parts in shared)))  # the folder in which all of them are
    folders = (
        [source.images] if source.images else [path.parent / common, path.parent / "images", path.parent]
    )
    images = []
    for frame, name in zip(frames, names, strict=True):
        spelled = str(PurePosixPath(name).relative_to(common))
        matrix = frame["transform_matrix"]
        images.append(posed_image(matrix, frame["file_path"], folders, FLIP_YZ, spelled=spelled))
    train, test = (
        _stems(content, key, path.parent, names, common) for key in ("train_filenames", "test_filenames")
    )
    return ImportedScene(images, *read_point_cloud(_cloud(source, path, content), source.memory), train, test)


def _check_camera(frame: JsonNode, content: JsonNode) -> None:
    """The camera of a frame is its own or that of the file; nothing may be cropped or shifted."""

    def setting(key: str) -> JsonNode | None:
        own = frame.get(key)
        return content.get(key) if own is None else own

    model = setting("camera_model")
    if model is None or model.text().upper() != "EQUIRECTANGULAR":
        found = "none" if model is None else model.text()[:40]
        raise (frame if model is None else model).error(
            f"the camera model is {found}; only EQUIRECTANGULAR is a panorama"
        )
    for middle, size in (("cx", "w"), ("cy", "h")):
        at, extent = setting(middle), setting(size)
        if at is not None and extent is not None and abs(at.array() - extent.array() / 2) > 1:
            raise at.error(f"{middle} is not the middle of the image; a panorama cannot be shifted")


def _cloud(source: ImportSource, path: Path, content: JsonNode) -> Path | None:
    if source.points:
        return source.points
    entry = content.get("ply_file_path")
    if entry is None:
        return None
    name = PurePosixPath(entry.text())
    if name.is_absolute() or ".." in name.parts:
        raise entry.error("leaves the folder of the file; give the cloud with --points")
    return path.parent / name


def _name(node: JsonNode, folder: Path) -> str:
    """A path to a panorama, relative to the folder of the file where it leads into it."""
    name = PurePosixPath(node.text().replace("\\", "/"))
    root = PurePosixPath(folder.resolve())
    return str(name.relative_to(root) if name.is_relative_to(root) else name)


def _stems(content: JsonNode, key: str, folder: Path, names: Sequence[str], common: str) -> list[str]:
    """The split, if the file has one."""
    entry = content.get(key)
    if entry is None:
        return []
    members = [_name(member, folder) for member in entry]
    return [stem_of(str(PurePosixPath(name).relative_to(common))) for name in members if name in names]
