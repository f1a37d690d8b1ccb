"""Metashape's camera XML (File > Export > Export Cameras) with a spherical sensor, and an exported PLY.

A camera's `transform` (16 numbers, rows first) is camera-to-chunk: camera x right, y down, z forward
(right-handed), longitude 0, the middle column, at +z: u = W/2 + f atan2(X, Z), v = H/2 + f atan(Y / sqrt(X² +
Z²)), f = W / 2π, pixel centres at +0.5. The transform of the camera's component (formerly of the chunk) leads
from chunk to world: X_world = scale · rotation · X + translation; the PLY is in world coordinates if both
were exported in local ones, in metres if the chunk has a scale. Source: the Metashape manual, appendix
"Camera models"; nerfstudio's process_data/metashape_utils.py. Not verified on a file from Metashape itself.

A chunk with geographic coordinates leads to the centre of the earth, whereas its PLY is projected: that is
refused. Labels are file names, often without extension. Cameras without a transform are not aligned and left
out, and so are those that the user has disabled. Cameras that did not align with the others are in components
of their own: without transforms, each of these is a world by itself, and the largest is taken.
"""

from collections import defaultdict
from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np

from panolog.prepare.importers.interface import (
    Array,
    ImportedScene,
    ImportSource,
    find_panorama,
    nearest_rotation,
    pose_from_camera_to_world,
    read_head,
)
from panolog.prepare.importers.json_xml import load_xml, xml_numbers
from panolog.prepare.importers.point_cloud import read_point_cloud
from panolog.scene.errors import SceneError
from panolog.scene.files import some_of
from panolog.scene.write import PosedImage

_GEOCENTRIC = 1e6  # metres from the origin: the surface of the earth


def detect(source: ImportSource) -> bool:
    """Whether this is a camera XML or a folder with exactly one."""
    path = _find(source)
    head = read_head(path) if path is not None else b""
    return b"<document" in head and b"<chunk" in head


def read(source: ImportSource) -> ImportedScene:
    """Reads the scene; see `interface`."""
    path = _find(source) or source.path
    root = load_xml(path, source.memory)
    found = [(chunk, cameras) for chunk in root.iter("chunk") for cameras in chunk.findall("cameras")]
    if len(found) != 1:
        raise SceneError(f"{path}: has {len(found)} chunks with cameras; export one chunk")
    chunk, cameras = found[0]
    spherical = {s.get("id") for s in chunk.iter("sensor") if s.get("type") == "spherical"}
    components = {c.get("id"): _component(path, c) for c in chunk.iter("component")}
    whole = _component(path, chunk)
    folders = source.image_folders("images", "imgs")
    images, (aligned, notes) = [], _aligned(cameras, chunk)
    for camera in aligned:
        label = camera.get("label") or ""
        field = f"camera {label[:60]!r}"
        transform = camera.find("transform")
        if transform is None or camera.get("sensor_id") not in spherical:
            raise SceneError(f"{path}: {field}: its sensor is not spherical; set its type and align again")
        to_world = components.get(camera.get("component_id"), whole)
        matrix = to_world @ xml_numbers(path, f"{field}: transform", transform.text, 16).reshape(4, 4)
        pose = pose_from_camera_to_world(f"{path}: {field}: transform", matrix, np.eye(3))
        images.append(PosedImage(*find_panorama(f"{path}: {field}", folders, label), *pose))
    return ImportedScene(images, *read_point_cloud(_cloud(source, path), source.memory), notes=notes)


def _aligned(cameras: Element, chunk: Element) -> tuple[list[Element], list[str]]:
    """The cameras that share a world, and one line for each kind that is left out."""
    left_out = defaultdict[str, list[Element]](list)
    parts = defaultdict[str | None, list[Element]](list)
    placed = {it.get("id") for it in chunk.iter("component") if it.find("transform") is not None}
    for camera in cameras.iter("camera"):
        if camera.find("transform") is None:
            left_out["not aligned"].append(camera)
        elif (camera.get("enabled") or "true").lower() in ("false", "0"):
            left_out["disabled"].append(camera)
        else:
            component = camera.get("component_id")
            parts[None if component in placed else component].append(camera)
    for world, apart in sorted(parts.items(), key=lambda part: -len(part[1]))[1:]:  # stable
        name = "the components with a place" if world is None else f"component {world}"
        left_out[f"in {name}, which nothing connects with the largest one"] += apart
    notes = [
        f"{some_of([(it.get('label') or '')[:80] for it in group], 'camera')}: left out, as "
        f"{'they are' if len(group) > 1 else 'it is'} {why}"
        for why, group in left_out.items()
    ]
    return max(parts.values(), key=len, default=[]), notes


def _find(source: ImportSource) -> Path | None:
    if source.path.is_file():
        return source.path if source.path.suffix.lower() == ".xml" else None
    found = sorted(source.path.glob("*.xml"))
    return found[0] if len(found) == 1 else None


def _component(path: Path, owner: Element) -> Array:
    """(4, 4) chunk to world: the identity where there is no transform."""
    matrix = np.eye(4)
    transform = owner.find("transform")
    if transform is None:
        return matrix
    field = f"{owner.tag} {owner.get('id', '')}: transform"
    scale, turn, shift = (transform.find(name) for name in ("scale", "rotation", "translation"))
    factor = 1.0 if scale is None else float(xml_numbers(path, f"{field}: scale", scale.text, 1)[0])
    if not factor > 0:
        raise SceneError(f"{path}: {field}: the scale {factor:g} is not positive")
    if turn is not None:
        numbers = xml_numbers(path, f"{field}: rotation", turn.text, 9).reshape(3, 3)
        matrix[:3, :3] = factor * nearest_rotation(f"{path}: {field}: rotation", numbers)
    else:
        matrix[:3, :3] *= factor
    if shift is not None:
        matrix[:3, 3] = xml_numbers(path, f"{field}: translation", shift.text, 3)
    if np.abs(matrix[:3, 3]).max() > _GEOCENTRIC:
        raise SceneError(
            f"{path}: {field}: leads to geocentric coordinates; set the chunk's coordinate system to "
            "Local Coordinates (m) and export cameras and points again"
        )
    return matrix


def _cloud(source: ImportSource, path: Path) -> Path | None:
    """The user's PLY, or the only one next to the XML, if any."""
    if source.points is not None:
        return source.points
    found = sorted(path.parent.glob("*.ply"))
    if not found:
        return None
    if len(found) > 1:
        raise SceneError(f"{path}: {len(found)} PLYs are next to it; say which is its cloud with --points")
    return found[0]
