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

from panolog.prepare.importers.interface import FLIP_YZ, ImportedScene, ImportSource, posed_image
from panolog.prepare.importers.json_xml import JsonNode, load_json
from panolog.prepare.importers.point_cloud import read_point_cloud
from panolog.scene.files import stem_of

FILES = ("transforms.json",)
_UNNAMED = (
    "there is no camera_model: taken to be EQUIRECTANGULAR, as the pictures are 2:1; `panolog scene check` "
    "says whether the poses fit"
)


def detect(source: ImportSource) -> bool:
    """Whether this is a transforms.json or a folder with one."""
    head = source.json_head(*FILES)
    named = b'"camera_model"' in head or source.json_file(*FILES).name in FILES
    return head.startswith(b"{") and b'"transform_matrix"' in head and named


def read(source: ImportSource) -> ImportedScene:
    """Reads the scene; see `interface`."""
    path = source.json_file(*FILES)
    content = load_json(path, source.memory)
    frames = list(content["frames"])
    unnamed = [frame for frame in frames if not _check_camera(frame, content)]
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
    images, masks = [], dict[str, Path]()
    for frame, name in zip(frames, names, strict=True):
        spelled = str(PurePosixPath(name).relative_to(common))
        matrix = frame["transform_matrix"]
        images.append(posed_image(matrix, frame["file_path"], folders, FLIP_YZ, spelled=spelled))
        if (mask := _mask(path.parent, frame, content)) is not None:
            masks[images[-1].name] = mask
    notes = [_UNNAMED] if unnamed else []
    depths = sum("depth_file_path" in frame.value for frame in frames)
    if depths:
        notes.append(f"{depths} depth maps are left out; `panolog scene depth` makes them")
    train, test = (
        _stems(content, key, path.parent, names, common) for key in ("train_filenames", "test_filenames")
    )
    cloud = read_point_cloud(_cloud(source, path, content), source.memory)
    return ImportedScene(images, *cloud, train, test, notes, masks=masks)


def _mask(folder: Path, frame: JsonNode, content: JsonNode) -> Path | None:
    """The mask of a frame, or that of all. Raises SceneError if it is not in the folder of the file."""
    own = frame.get("mask_path")
    entry = content.get("mask_path") if own is None else own
    if entry is None or not entry.value:
        return None
    mask = folder / _name(entry, folder)
    if ".." in mask.parts or not mask.is_file() or not mask.resolve().is_relative_to(folder.resolve()):
        raise entry.error(
            "there is no such mask in the folder of the file; copy it there, or remove the entry"
        )
    return mask


def _check_camera(frame: JsonNode, content: JsonNode) -> bool:
    """Whether the camera of a frame, its own or that of the file, is named; None may be cropped or shifted.

    Raises SceneError if it is no panorama. One without a name may be one, unless it has a field of view.
    """

    def setting(key: str) -> JsonNode | None:
        own = frame.get(key)
        return content.get(key) if own is None else own

    model = setting("camera_model")
    if model is None and (angle := setting("camera_angle_x")) is not None:
        raise angle.error("a camera with a field of view; only EQUIRECTANGULAR is a panorama")
    if model is not None and model.text().upper() != "EQUIRECTANGULAR":
        raise model.error(f"the camera model is {model.text()[:40]}; only EQUIRECTANGULAR is a panorama")
    for middle, size in (("cx", "w"), ("cy", "h")):
        at, extent = setting(middle), setting(size)
        if at is not None and extent is not None and abs(at.array() - extent.array() / 2) > 1:
            raise at.error(f"{middle} is not the middle of the image; a panorama cannot be shifted")
    return model is not None


def _cloud(source: ImportSource, path: Path, content: JsonNode) -> Path | None:
    if source.points:
        return source.points
    entry = content.get("ply_file_path")
    # Versions of nerfstudio and other programs write it without an entry.
    if entry is None or not entry.value:
        return source.cloud_file("sparse_pc.ply", "pointcloud.ply", "point_cloud.ply", "points3D.ply")
    name = PurePosixPath(_name(entry, path.parent))
    if name.is_absolute() or ".." in name.parts:
        raise entry.error("leaves the folder of the file; give the cloud with --points")
    if not (path.parent / name).is_file():
        raise entry.error("there is no such file; give the cloud with --points, or remove the entry")
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
    return [
        stem_of(str(PurePosixPath(name).relative_to(common) if name in names else name)) for name in members
    ]
