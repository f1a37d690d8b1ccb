"""OpenSfM's reconstruction.json with spherical (formerly equirectangular) cameras, and its tracks.csv.

Camera x right, y down, z forward; longitude 0, the middle column, is +z. `rotation` is the axis times the
angle of the world-to-camera rotation, `translation` its translation: X_cam = R X + t. Right-handed. With GPS
the world is topocentric, x east, y north, z up, in metres, about the place in reference_lla.json; without, z
is about up and the unit arbitrary. Positions in tracks.csv are normalised: (u + 0.5 - W/2) / W, so pixel
centres are where ours are. Source: OpenSfM's doc/source/geometry.rst, opensfm/io.py, opensfm/features.py and
SphericalProjection in its C++.

The file may hold several reconstructions that are not connected: the largest is taken.
"""

from array import array
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from pydantic import ValidationError
from scipy.spatial.transform import Rotation

from panolog.prepare.importers.interface import ImportedScene, ImportSource, find_panorama
from panolog.prepare.importers.json_xml import JsonNode, load_json
from panolog.prepare.importers.point_cloud import read_point_cloud
from panolog.scene.errors import SceneError
from panolog.scene.write import UNSEEN, Origin, PosedImage, Sightings

FILES = ("reconstruction.json", "opensfm/reconstruction.json")
_PANORAMA = ("spherical", "equirectangular")


def detect(source: ImportSource) -> bool:
    """Whether this is a reconstruction.json or a folder with one."""
    head = source.json_head(*FILES)
    return head.startswith(b"[") and b'"cameras"' in head and b'"projection_type"' in head


def read(source: ImportSource) -> ImportedScene:
    """Reads the scene; see `interface`."""
    path = source.json_file(*FILES)
    parts = sorted(
        load_json(path, source.memory), key=lambda part: -len(part["shots"])
    )  # stable: the first of equal ones
    if not parts:
        raise SceneError(f"{path}: contains no reconstruction; run OpenSfM again")
    largest = parts[0]
    left_out = sum(len(part["shots"]) for part in parts[1:])
    notes = (
        [f"{left_out} images of {len(parts) - 1} smaller reconstructions are left out"] if left_out else []
    )
    points = largest["points"]
    rows = {key: row for row, (key, _) in enumerate(points.items())}
    tracks = path.parent / "tracks.csv"
    shots = {name for name, _ in largest["shots"].items()}
    sightings = (
        _sightings(tracks, shots, rows, source.memory) if tracks.is_file() and not source.points else {}
    )
    images = _images(largest, source.image_folders("images"), sightings)
    place = _place(largest, path.with_name("reference_lla.json"), source.memory)
    if source.points:
        cloud = read_point_cloud(source.points, source.memory)
        return ImportedScene(images, *cloud, notes=notes, place=place)
    where = np.array([point["coordinates"].array(3) for _, point in points.items()]).reshape(-1, 3)
    colors = np.array([point["color"].array(3) for _, point in points.items()]).reshape(-1, 3)
    rgb = np.clip(np.rint(colors), 0, 255).astype(np.uint8)
    return ImportedScene(images, where, rgb, notes=notes, place=place)


def _place(part: JsonNode, file: Path, memory: int) -> Origin | None:
    """The place on the earth that the world is about; None without GPS: then it is at latitude, longitude 0.

    Raises SceneError if it is none.
    """
    found = part.get("reference_lla")
    if found is None and file.is_file():
        found = load_json(file, memory)
    if found is None:
        return None
    latitude, longitude, altitude = (
        float(found[name].array()) for name in ("latitude", "longitude", "altitude")
    )
    if latitude == longitude == 0:
        return None
    try:
        return Origin(latitude=latitude, longitude=longitude, altitude=altitude)
    except ValidationError as error:
        raise found.error("is no place on the earth; run OpenSfM again") from error


def _images(part: JsonNode, folders: Sequence[Path], sightings: dict[str, Sightings]) -> list[PosedImage]:
    kinds = {key: camera["projection_type"] for key, camera in part["cameras"].items()}
    images = []
    for name, shot in part["shots"].items():
        kind = kinds.get(shot["camera"].text())
        if kind is None:
            raise shot["camera"].error("the reconstruction has no such camera")
        if kind.text() not in _PANORAMA:
            raise kind.error(f"{kind.text()[:40]} is not a panorama; only spherical cameras can be used")
        rotation = Rotation.from_rotvec(shot["rotation"].array(3)).as_matrix()
        translation = shot["translation"].array(3)
        found = find_panorama(shot.where, folders, name)
        images.append(PosedImage(*found, rotation, translation, sightings.get(name, UNSEEN)))
    return images


def _sightings(path: Path, shots: set[str], rows: dict[str, int], memory: int) -> dict[str, Sightings]:
    """By image, which points it sees and where, of the images `shots`.

    Columns: image, track, feature, x, y, then others; the first line may be the version.
    """
    if path.stat().st_size > memory // 5:  # a line of ten bytes or more becomes 24, twice at the end
        raise SceneError(
            f"{path}: too large to be read with the memory that is free; free some, or move it away, and the "
            "scene comes without tracks"
        )
    found: dict[str, tuple[array[int], array[float]]] = {}
    with path.open(encoding="utf-8", errors="replace") as file:
        for number, line in enumerate(file, start=1):
            words = line.rstrip("\r\n").split("\t")
            if (number == 1 and line.startswith("OPENSFM_TRACKS_VERSION")) or not line.strip():
                continue
            try:
                x, y = float(words[3]), float(words[4])
            except (IndexError, ValueError) as error:
                raise SceneError(f"{path}: line {number} is not an observation; export it again") from error
            if not (abs(x) <= 0.5 and abs(y) <= 0.25):  # also what is not a number
                raise SceneError(f"{path}: line {number}: ({x:.4g}, {y:.4g}) is outside of a panorama")
            row = rows.get(words[1])
            if row is not None and words[0] in shots:
                seen, where = found.setdefault(words[0], (array("q"), array("d")))
                seen.append(row)
                where.extend((x + 0.5, 2 * y + 0.5))
    return {
        name: (np.array(seen, np.int64), np.array(where).reshape(-1, 2))
        for name, (seen, where) in found.items()
    }
