"""Where on the earth a model is, and in which frame its exports are: georef.json."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from panolog.export.coordinates import GEOCENTRIC, check_unit, is_plane, to_geocentric
from panolog.export.earth import enu_to_ecef, geodetic_of
from panolog.export.frame import HALF_TURN, Y_DOWN, Frame
from panolog.scene.errors import ConfigError, SceneError
from panolog.scene.model import NO_OFFSET, Scene, Vector
from panolog.scene.write import Origin, read_offset

_AGREEMENT = 0.7  # length of the mean of the cameras' unit ups from which on they have one
_SNAP = 0.996  # cosine of 5 degrees: an up so close to an axis of the world is that axis
_STEP = 10.0  # units, over which a projection is taken to be linear: it errs by less than a millimetre

Doubles = NDArray[np.float64]

_TILES = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])  # the axes of exports of those of 3D Tiles


@dataclass(frozen=True)
class Georeference:
    """What is known of the place of a model. Coordinates of the model plus `offset` are the source's."""

    up: Vector = Y_DOWN  # unit, in the model's coordinates
    middle: Vector = NO_OFFSET  # of the cameras, in whole units of the model: the origin of exports
    offset: Vector = NO_OFFSET
    origin: Origin | None = None  # the source's coordinates are metres east, north and up of it
    epsg: int | None = None  # the source's coordinate system
    metres: float | None = None  # of a unit, as the user or the scene says; None = not known
    geoid: float | None = None  # metres above the ellipsoid, if heights are above the sea

    @property
    def unit(self) -> float | None:
        """Metres of a unit; None if nothing is known of it.

        Raises InputError if the coordinate system is not known, or has another unit than `metres` says.
        """
        if self.epsg is not None:
            return check_unit(self.epsg, self.metres)
        if self.origin is not None and self.metres not in (None, 1.0):
            raise ConfigError("the scene is in metres east, north and up of its place; leave out the metres")
        return self.metres

    @property
    def frame(self) -> Frame:
        """The frame of exports: y up, the origin among the cameras."""
        return Frame.upright(self.up, np.array(self.middle))

    @property
    def upside_down(self) -> Frame:
        """The frame of PLY and SOG: `frame` by half a turn around z, which PlayCanvas's viewers undo."""
        upright = self.frame
        return Frame(HALF_TURN.rotation @ upright.rotation, upright.origin)

    @property
    def heights_known(self) -> bool:
        """Whether it is known what heights are above. Raises InputError as `unit`."""
        return self.geoid is not None or (self.epsg is not None and not is_plane(self.epsg))

    def to_ecef(self) -> Doubles | None:
        """(4, 4) from the model's coordinates to metres from the earth's middle (WGS84); None if unknown.

        Raises InputError if the coordinate system cannot be converted.
        """
        offset = np.eye(4)
        offset[:3, 3] = self.offset
        if self.origin is not None:
            place = self.origin
            height = place.altitude + (self.geoid or 0)
            return enu_to_ecef(place.latitude, place.longitude, height) @ offset
        if self.epsg == GEOCENTRIC:
            return offset
        return None if self.epsg is None else self._in_system(self.epsg)

    def tiles_to_ecef(self) -> Doubles | None:
        """(4, 4) from the axes of 3D Tiles, x, −z and y of an export in metres, to ECEF.

        Rigid: a projection's scale, some tenths of a thousandth, is left out. None and what it raises as
        `to_ecef`.
        """
        ecef = self.to_ecef()
        if ecef is None:
            return None
        frame, tiles = self.frame, np.eye(4)
        tiles[:3, :3] = frame.rotation.T @ _TILES
        tiles[:3, 3] = frame.origin
        found = ecef @ tiles
        left, _, right = np.linalg.svd(found[:3, :3])
        found[:3, :3] = left @ right
        return np.asarray(found)

    def as_json(self, provenance: Mapping[str, Any]) -> dict[str, Any]:
        """The content of georef.json. Args: provenance, what the model was made of."""
        frame, ecef = self.frame, self.to_ecef()
        place = None
        if ecef is not None:
            latitude, longitude, height = geodetic_of((ecef @ np.append(frame.origin, 1))[:3])
            place = {"latitude": latitude, "longitude": longitude, "height": height}
        return {
            "version": 1,
            "model": {
                "up": list(self.up),
                "offset": list(self.offset),
                "frame": "ENU" if self.origin else None,
                "origin": self.origin.model_dump() if self.origin else None,
                "epsg": self.epsg,
                "metres_per_unit": self.unit,
                "geoid": self.geoid,
                "to_ecef": None if ecef is None else ecef.tolist(),
            },
            "exports": {
                "axes": "x right, y up, z backward",
                "in_metres": [".glb", "tileset.json"],
                "half_turn_around_z": [".sog", ".ply", ".compressed.ply", "lod-meta.json"],  # .ply: of --ply
                "rotation": frame.rotation.tolist(),
                "origin": frame.origin.tolist(),
                "wgs84": place,
            },
            "provenance": dict(provenance),
        }

    def _in_system(self, epsg: int) -> Doubles:
        """`to_ecef` of a coordinate system."""
        middle = np.array(self.offset) + self.middle
        points = middle + _STEP * np.concatenate([np.zeros((1, 3)), np.eye(3)])
        found = to_geocentric(epsg, points, self.geoid)
        linear = np.eye(4)
        linear[:3, :3] = (found[1:] - found[0]).T / _STEP
        linear[:3, 3] = found[0] - linear[:3, :3] @ self.middle
        return linear


def georeference_of(scene: Scene) -> Georeference:
    """What a scene says of its place: its cameras, and offset.json. Raises SceneError if that is wrong."""
    known = read_offset(scene.root)
    middle = tuple(np.round(scene.centers.mean(axis=0)).tolist())
    found = Georeference(_up(scene), middle, scene.offset)
    if known is None:
        return found
    return replace(
        found,
        up=(0.0, 0.0, 1.0) if known.frame == "ENU" else found.up,
        offset=tuple((np.array(scene.offset) + known.offset).tolist()),
        origin=known.origin,
        epsg=known.epsg,
        metres=known.metres or (1.0 if known.frame else None),
        geoid=known.geoid,
    )


def georeference_from(content: Any, where: object) -> Georeference:
    """The inverse of `Georeference.as_json`. Raises InputError that names `where`."""
    try:
        model, exports = content["model"], content["exports"]
        origin = None if model["origin"] is None else Origin.model_validate(model["origin"])
        vectors = np.array([model["up"], exports["origin"], model["offset"]], np.float64)
        if vectors.shape != (3, 3) or not np.isfinite(vectors).all():
            raise ValueError("a direction or a place is not three numbers")
        up, middle, offset = map(tuple, vectors.tolist())
        known = model["epsg"], model["metres_per_unit"], model.get("geoid")
        return Georeference(up, middle, offset, origin, *known)
    except (KeyError, TypeError, ValueError) as error:
        raise SceneError(f"{where}: is not of this PanoLOG's format: {error}; remove it") from error


def _up(scene: Scene) -> Vector:
    """The mean up of the cameras; that of COLMAP's axes where they have none in common."""
    mean = -np.mean([panorama.rotation[1] for panorama in scene.panoramas], axis=0)
    length = float(np.linalg.norm(mean))
    if length < _AGREEMENT:
        return Y_DOWN
    up = mean / length
    axis = int(np.abs(up).argmax())
    if abs(up[axis]) > _SNAP:
        up = np.sign(up[axis]) * np.eye(3)[axis]
    return (float(up[0]), float(up[1]), float(up[2]))
