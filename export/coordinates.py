"""Coordinate systems that models are in: their unit, and the way to metres from the middle of the earth.

PROJ knows them by their EPSG numbers. A model has one unit along all axes, so its heights are in that of its
plane. A system of a plane says nothing of heights: they are above its ellipsoid, or, where the user says how
high the geoid is there, above the sea. A system with heights above the sea needs a grid of the geoid, and
PROJ would leave the difference out, of up to 100 m, where that is missing: that is refused.
"""

from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from panolog.export.earth import geocentric
from panolog.scene.errors import ConfigError, require

if TYPE_CHECKING:
    from pyproj import CRS

Doubles = NDArray[np.float64]
GEOCENTRIC = 4978  # WGS84 as x, y, z in metres from the middle of the earth
_SAME = 1e-3  # relative difference of two units that are meant to be the same


@lru_cache(maxsize=8)
def unit_of(epsg: int) -> float:
    """Metres of a unit of a coordinate system.

    Raises ConfigError if there is no such system, it is in degrees, or its axes have several units.
    """
    if epsg == GEOCENTRIC:
        return 1.0
    system = _system(epsg)
    units = {axis.unit_name: axis.unit_conversion_factor for axis in system.axis_info}
    if system.is_geographic or not (system.is_projected or system.is_geocentric):
        raise ConfigError(
            f"EPSG:{epsg} ({system.name}): is in {' and '.join(units)}, and a model's axes are lengths; "
            "give a projected system, such as that of UTM there"
        )
    factors = list(units.values())
    if max(factors) - min(factors) > _SAME * min(factors):
        raise ConfigError(
            f"EPSG:{epsg} ({system.name}): has axes in {' and '.join(units)}, and a model has one unit; give "
            "the system of the plane alone"
        )
    return float(factors[0])


def check_unit(epsg: int, metres: float | None) -> float:
    """`unit_of` a system. Raises ConfigError if it is not the `metres` that were given."""
    unit = unit_of(epsg)
    if metres is not None and abs(metres - unit) > _SAME * unit:
        raise ConfigError(f"EPSG:{epsg} has units of {unit:.6g} m, not of {metres:g} m; leave out the metres")
    return unit


def is_plane(epsg: int) -> bool:
    """Whether a coordinate system has no heights. Raises ConfigError as `unit_of`."""
    return epsg != GEOCENTRIC and len(_system(epsg).axis_info) == 2


def to_geocentric(epsg: int, points: Doubles, geoid: float | None) -> Doubles:
    """(N, 3) metres in EPSG:4978 of points (N, 3): east, north and up, or geocentric, in the system's unit.

    Args: geoid, metres of the geoid above the ellipsoid there, if heights are above the sea.
    Raises ConfigError as `unit_of`, if the points are not within the system, or if it has heights above the
    sea and there is no grid for them.
    """
    unit, system = unit_of(epsg), _system(epsg)
    from pyproj import CRS, Transformer  # noqa: PLC0415  # `_system` has found it
    from pyproj.exceptions import ProjError  # noqa: PLC0415

    plane = is_plane(epsg)
    if geoid is not None and not plane:
        raise ConfigError(f"EPSG:{epsg} ({system.name}): has heights of its own; leave out the geoid")
    x, y, z = points.T
    heights = z * unit if plane else z
    try:
        target = CRS.from_epsg(4326 if geoid is not None else GEOCENTRIC)
        source = system if geoid is not None or not plane else system.to_3d()
        convert = Transformer.from_crs(source, target, always_xy=True, allow_ballpark=False)
        if geoid is None:
            return np.stack(convert.transform(x, y, heights, errcheck=True), axis=1)
        longitudes, latitudes = convert.transform(x, y, errcheck=True)
        places = zip(latitudes, longitudes, heights + geoid, strict=True)
        return np.stack([geocentric(*map(float, place)) for place in places])
    except (ProjError, ValueError) as error:
        reason = f"cannot be converted to WGS84: {error}"
        if system.is_compound:
            flat = system.sub_crs_list[0].to_epsg()
            reason = (
                "has heights above the sea, and PROJ has no grid of the geoid here; install it with "
                f"`projsync --all`, or give EPSG:{flat} and with --geoid how high the geoid is there"
            )
        raise ConfigError(f"EPSG:{epsg} ({system.name}): {reason}") from error


def _system(epsg: int) -> "CRS":
    """Raises MissingPackageError without PROJ, and ConfigError if it knows no such system."""
    require("pyproj")
    from pyproj import CRS  # noqa: PLC0415  # needed for this alone
    from pyproj.exceptions import CRSError  # noqa: PLC0415

    try:
        return CRS.from_epsg(epsg)
    except CRSError as error:
        raise ConfigError(f"EPSG:{epsg}: cannot be converted to WGS84: {error}") from error
