"""The known scene in every format that can be imported, written from what the formats say of themselves."""

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from panolog.prepare.importers.interface import ImportSource
from tests.prepare.importers.colmap_writers import egonerf, panorama_sfm, spheresfm
from tests.prepare.importers.files import write_json, write_ply, write_split
from tests.prepare.importers.known import Array, Known, make_known

OPENGL = np.diag([1.0, -1.0, -1.0])  # x right, y up, z backward
Writer = Callable[[Path], tuple[Known, ImportSource]]


def _frames(known: Known, key: str, axes: Array, folder: str = "") -> list[dict[str, Any]]:
    """Each panorama's name at `key`, and its camera-to-world pose with other axes (3, 3) of the camera."""
    return [
        {key: folder + name, "transform_matrix": known.camera_to_world(index, axes).tolist()}
        for index, name in enumerate(known.names)
    ]


def openmvg_parts(known: Known, *, mirrored: bool = False) -> dict[str, Any]:
    """An sfm_data: columns counted from their centres, and in old versions y up in the camera."""
    half = Rotation.from_euler("y", -np.pi / known.width).as_matrix()  # columns are half a pixel further left
    flip = np.diag([1.0, -1.0, 1.0]) if mirrored else np.eye(3)
    views, extrinsics = [], []
    for key, name in enumerate(known.names):
        data = {"local_path": "/", "filename": name, "width": known.width, "height": known.height}
        data |= {"id_view": key, "id_intrinsic": 0, "id_pose": 10 + key}
        wrapper = {"id": 2**31 + key + 2, "data": data}
        views.append({"key": key, "value": {"polymorphic_id": 2**30, "ptr_wrapper": wrapper}})
        pose = {"rotation": (flip @ half @ known.rotations[key] @ flip).tolist()}
        pose["center"] = (flip @ known.centers[key]).tolist()
        extrinsics.append({"key": 10 + key, "value": pose})
    size = {"value0": {"width": known.width, "height": known.height}}
    spherical = {"polymorphic_id": 2**31 + 1, "polymorphic_name": "spherical"}
    intrinsic = spherical | {"ptr_wrapper": {"id": 2**31 + 99, "data": size}}
    structure = []
    for row, point in enumerate(known.points @ flip):
        observations = []
        for view, (rows, pixels) in enumerate(zip(known.observed, known.pixels, strict=True)):
            for at in np.flatnonzero(rows == row):
                x = (pixels[at] - 0.5).tolist()
                observations.append({"key": view, "value": {"id_feat": int(at), "x": x}})
        structure.append({"key": row, "value": {"X": point.tolist(), "observations": observations}})
    return {
        "sfm_data_version": "0.3",
        "root_path": "",
        "views": views,
        "intrinsics": [{"key": 0, "value": intrinsic}],
        "extrinsics": extrinsics,
        "structure": structure,
        "control_points": [],
    }


def _colorized(known: Known, path: Path, flip: Array) -> None:
    """openMVG's cloud: the cameras are green vertices after the points."""
    points = np.concatenate([known.points, known.centers]) @ flip
    green = np.tile(np.array([[0, 255, 0]], np.uint8), (len(known.centers), 1))
    write_ply(path, points, np.concatenate([known.colors, green]), ascii_ply=True)


def openmvg(folder: Path, *, mirrored: bool = False) -> tuple[Known, ImportSource]:
    known = make_known(folder)
    write_json(folder / "sfm_data.json", openmvg_parts(known, mirrored=mirrored))
    _colorized(known, folder / "colorized.ply", np.diag([1.0, -1.0 if mirrored else 1.0, 1.0]))
    return known, ImportSource(folder)


def omnigs_input(folder: Path) -> tuple[Known, ImportSource]:
    """What OmniGS trains on: poses without structure, and the colorized cloud."""
    known = make_known(folder)
    below = folder / "openMVG" / "reconstruction"
    write_json(
        below / "poses.json", openmvg_parts(known) | {"structure": [], "root_path": str(folder / "images")}
    )
    _colorized(known, below / "colorized.ply", np.eye(3))
    return known, ImportSource(folder)


def omnigs(folder: Path) -> tuple[Known, ImportSource]:
    known = make_known(folder)
    keyframes = []
    for index, name in enumerate(known.names):
        pose = known.camera_to_world(index, np.eye(3))
        entry = {"id": index, "img_name": name, "width": known.width, "height": known.height}
        entry |= {"position": pose[:3, 3].tolist(), "rotation": pose[:3, :3].tolist(), "fx": 0, "fy": 0}
        keyframes.append(entry)
    write_json(folder / "cameras.json", keyframes)
    write_ply(folder / "input.ply", known.points, known.colors)
    return known, ImportSource(folder)


def opensfm(folder: Path) -> tuple[Known, ImportSource]:
    known = make_known(folder)
    camera = {"projection_type": "spherical", "width": known.width, "height": known.height}
    shots = {}
    for index, name in enumerate(known.names):
        rotation = Rotation.from_matrix(known.rotations[index]).as_rotvec().tolist()
        translation = known.translations[index].tolist()
        shots[name] = {"rotation": rotation, "translation": translation, "camera": "theta", "orientation": 1}
    points = {
        str(3 * row + 5): {"color": known.colors[row].astype(float).tolist(), "coordinates": point.tolist()}
        for row, point in enumerate(known.points)
    }
    best = {"cameras": {"theta": camera}, "shots": shots, "points": points}
    small = {"cameras": {"theta": camera}, "shots": {"lost.png": shots[known.names[0]]}, "points": {}}
    write_json(folder / "reconstruction.json", [small, best])
    lines = ["OPENSFM_TRACKS_VERSION_v2"]
    for name, rows, pixels in zip(known.names, known.observed, known.pixels, strict=True):
        middle = (known.width / 2, known.height / 2)
        for at, (row, (x, y)) in enumerate(zip(rows, (pixels - middle) / known.width, strict=True)):
            words = (name, 3 * row + 5, at, float(x), float(y), 0.004, 1, 2, 3, -1, -1)
            lines.append("\t".join(map(str, words)))
    (folder / "tracks.csv").write_text("\n".join(lines) + "\n")
    return known, ImportSource(folder)


def nerfstudio(folder: Path) -> tuple[Known, ImportSource]:
    known = make_known(folder)
    frames = _frames(known, "file_path", OPENGL, "./images/")
    content = {"camera_model": "EQUIRECTANGULAR", "w": known.width, "h": known.height, "frames": frames}
    content |= {"fl_x": known.height, "fl_y": known.height, "cx": known.width / 2, "cy": known.height / 2}
    content |= {"ply_file_path": "sparse_pc.ply", "applied_transform": np.eye(4)[[2, 0, 1]].tolist()}
    write_json(folder / "transforms.json", content)
    write_ply(folder / "sparse_pc.ply", known.points, known.colors)
    return known, ImportSource(folder)


def metashape(folder: Path) -> tuple[Known, ImportSource]:
    """Cameras in a chunk's own coordinates, a component that leads to the world, labels without extension."""
    known = make_known(folder)
    scale, shift = 2.5, np.array([4.0, -7.0, 1.5])
    turn = Rotation.from_euler("xyz", [0.3, -0.8, 1.1]).as_matrix()

    def words(values: Array) -> str:
        return " ".join(map(repr, values.ravel().tolist()))

    cameras = ""
    for index, name in enumerate(known.names):
        chunk = np.eye(4)
        chunk[:3, :3] = turn.T @ known.rotations[index].T
        chunk[:3, 3] = turn.T @ (known.centers[index] - shift) / scale
        cameras += f'<camera id="{index}" sensor_id="3" component_id="0" label="{Path(name).stem}">'
        cameras += f"<transform>{words(chunk)}</transform></camera>\n"
    cameras += '<camera id="99" sensor_id="3" component_id="0" label="not aligned"/>\n'
    size = f'<resolution width="{known.width}" height="{known.height}"/>'
    (folder / "cameras.xml").write_text(
        '<?xml version="1.0" encoding="UTF-8"?>\n<document version="2.0.0"><chunk label="Chunk 1">'
        f'<sensors next_id="4"><sensor id="3" label="THETA" type="spherical">{size}</sensor></sensors>'
        f'<components next_id="1" active_id="0"><component id="0" label="Component 1"><transform>'
        f'<rotation locked="0">{words(turn)}</rotation><translation locked="0">{words(shift)}</translation>'
        f'<scale locked="0">{scale!r}</scale></transform></component></components>'
        f'<cameras next_id="100" next_group_id="0">{cameras}</cameras></chunk></document>\n'
    )
    write_ply(folder / "points.ply", known.points, known.colors)
    return known, ImportSource(folder)


def omniblender(folder: Path) -> tuple[Known, ImportSource]:
    known = make_known(folder)
    frames = _frames(known, "file_path", OPENGL)
    content = {"width": known.width, "height": known.height, "indoor": True, "frames": frames}
    write_json(folder / "transform.json", content)
    write_ply(folder / "elsewhere" / "cloud.ply", known.points, known.colors)
    write_split(folder, known)
    return known, ImportSource(folder, points=folder / "elsewhere" / "cloud.ply")


def roam360(folder: Path) -> tuple[Known, ImportSource]:
    known = make_known(folder)
    frames = _frames(known, "rgb_file", np.eye(3))
    write_json(folder / "pose_c2w.json", {"train": frames[:2] + frames[4:], "test": frames[2:4]})
    write_ply(folder / "scene.ply", known.points, known.colors)
    return known, ImportSource(folder)


def roam360_prepared(folder: Path) -> tuple[Known, ImportSource]:
    known = make_known(folder)
    parts = openmvg_parts(known) | {"intrinsics": [], "structure": []}
    write_json(folder / "data_views.json", parts | {"extrinsics": []})
    write_json(folder / "data_extrinsics.json", parts | {"views": []})
    write_ply(folder / "pcd.ply", known.points, known.colors, ascii_ply=True)
    write_split(folder, known)
    return known, ImportSource(folder)


def pose_table(folder: Path, *, angles: bool = False) -> tuple[Known, ImportSource]:
    """A table with quaternions in CSV, or with angles between blanks, and a cloud next to it."""
    known = make_known(folder)
    head, separator = ("# Label X Y Z Omega Phi Kappa", " ") if angles else ("name,x,y,z,qx,qy,qz,qw", ",")
    lines = [head]
    for index, name in enumerate(known.names):
        pose = known.camera_to_world(index, OPENGL if angles else np.eye(3))
        turn = Rotation.from_matrix(pose[:3, :3])
        attitude = turn.as_euler("XYZ", degrees=True) if angles else turn.as_quat()
        lines.append(separator.join([name, *map(repr, [*pose[:3, 3].tolist(), *attitude.tolist()])]))
    path = folder / ("poses.txt" if angles else "poses.csv")
    path.write_text("\n".join(lines) + "\n")
    write_ply(folder / "points.ply", known.points, known.colors)
    return known, ImportSource(path)


WRITERS: dict[str, tuple[str, Writer]] = {
    "openmvg": ("openmvg", openmvg),
    "openmvg, old": ("openmvg", partial(openmvg, mirrored=True)),
    "openmvg for OmniGS": ("openmvg", omnigs_input),
    "omnigs": ("omnigs", omnigs),
    "opensfm": ("opensfm", opensfm),
    "nerfstudio": ("nerfstudio", nerfstudio),
    "metashape": ("metashape", metashape),
    "spheresfm": ("spheresfm", spheresfm),
    "egonerf": ("egonerf", egonerf),
    "omniblender": ("omniblender", omniblender),
    "360roam": ("360roam", roam360),
    "360roam, prepared": ("360roam", roam360_prepared),
    "panorama_sfm": ("panorama_sfm", panorama_sfm),
    "poses": ("poses", pose_table),
    "poses, angles": ("poses", partial(pose_table, angles=True)),
    "panorama_sfm, one ring": ("panorama_sfm", partial(panorama_sfm, pitches=(0.0,))),
}
WITH_TRACKS = {"openmvg", "openmvg, old", "opensfm", "spheresfm", "egonerf"}
WITH_SPLIT = {"egonerf", "omniblender", "360roam", "360roam, prepared"}
