"""Gravity and GPS: known similarities come back, and insufficient data is not used."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pycolmap
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from panolog.prepare.world.exif import Attitude, GpsFix
from panolog.prepare.world.georeference import Georeference, georeference, scale_from_distance
from panolog.prepare.world.gps import collect_fixes
from panolog.prepare.world.similarity import Similarity
from panolog.scene.errors import InputError

Array = NDArray[np.float64]
ORIGIN = (47.3775, 8.5417, 408.5)
LEVEL = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])  # looks north
DOWN = np.array([0.0, 0.0, 1.0])


class World:
    """Cameras in east, north, up, and what SfM makes of them: the same in a frame of its own."""

    def __init__(self, centers: Array, *, tilt: float = 0.0, seed: int = 0) -> None:
        """`tilt`: degrees, standard deviation of pitch and roll."""
        self.random = np.random.default_rng(seed)
        self.centers = centers
        count = len(centers)
        self.angles = self.random.normal(0, tilt, (count, 2)) if tilt else np.zeros((count, 2))
        self.headings = self.random.uniform(0, 360, count)
        held = Rotation.from_euler("ZXY", np.column_stack([-self.headings, self.angles]), degrees=True)
        self.rotations = np.stack([LEVEL @ one.T for one in held.as_matrix()])
        self.truth = Similarity(
            float(self.random.uniform(0.1, 20)),
            Rotation.random(random_state=seed).as_matrix(),
            self.random.normal(0, 50, 3),
        )
        # SfM's world is what `truth` leads back from.
        self.sfm_rotations = self.rotations @ self.truth.rotation
        self.sfm_centers = (centers - self.truth.translation) @ self.truth.rotation / self.truth.scale

    def attitudes(self, headings: Sequence[float | None] | None = None) -> list[Attitude | None]:
        """Those of the files, with headings where given."""
        given = headings or [None] * len(self.angles)
        return [Attitude(it, *angles) for it, angles in zip(given, self.angles.tolist(), strict=True)]

    def fixes(self, noise: float = 0.0, vertical: float = 0.0, wrong: float = 0.0) -> list[GpsFix]:
        """GPS with noise in metres along each axis; a fraction `wrong` of them is up to 300 m off."""
        shape = (len(self.centers), 2)
        enu = self.centers.copy()
        enu[:, :2] += self.random.normal(0, 1, shape) * noise
        enu[:, 2] += self.random.normal(0, 1, len(enu)) * vertical
        off = self.random.permutation(len(enu)) < wrong * len(enu)
        enu[off, :2] += self.random.uniform(-300, 300, (int(off.sum()), 2))
        return fixes(enu)

    def solve(
        self,
        found: Sequence[GpsFix | None] | None = None,
        attitudes: Sequence[Attitude | None] | None = None,
        scale: float | None = None,
    ) -> Georeference:
        none = [None] * len(self.centers)
        return georeference(
            self.sfm_rotations, self.sfm_centers, attitudes or none, found or none, scale=scale
        )

    def errors(self, found: Georeference) -> Array:
        """(K, 3) metres, of the cameras in east, north, up of the test's own origin."""
        assert found.gps is not None
        origin = found.gps.fixes.origin
        place = (origin.latitude, origin.longitude, origin.altitude)
        back = np.asarray(transform().enu_to_ellipsoid(found.similarity.points(self.sfm_centers), *place))
        enu: Array = np.asarray(transform().ellipsoid_to_enu(back, *ORIGIN))
        off: Array = enu - self.centers
        return off


def transform() -> pycolmap.GPSTransform:
    return pycolmap.GPSTransform(pycolmap.GPSTransformEllipsoid.WGS84)


def fixes(enu: Array, origin: tuple[float, float, float] = ORIGIN) -> list[GpsFix]:
    """Fixes of positions (K, 3) around a place."""
    return [GpsFix(*map(float, row)) for row in np.asarray(transform().enu_to_ellipsoid(enu, *origin))]


def walk(count: int = 60, length: float = 200.0) -> Array:
    """(count, 3) around two corners, 1.7 m above ground that rises a little."""
    t = np.linspace(0, 1, count)
    east = np.interp(t, [0, 0.5, 0.8, 1], [0, 0.5, 0.5, 0.7]) * length
    north = np.interp(t, [0, 0.5, 0.8, 1], [0, 0, 0.3, 0.3]) * length
    return np.stack([east, north, 1.7 + 3 * t], axis=1)


def centred(centers: Array) -> Array:
    """The same (K, 3) with that camera at ORIGIN which gives the scene's: up differs by 1e-5 in 60 m."""
    found = collect_fixes(fixes(centers))
    assert found is not None
    row = np.argmin(np.linalg.norm(found.enu[:, :2], axis=1))
    moved: Array = centers - centers[row] * [1, 1, 0]
    return moved


def line(count: int = 40, length: float = 200.0) -> Array:
    """(count, 3) straight on."""
    t = np.linspace(0, length, count)
    return np.stack([0.8 * t, 0.6 * t, np.full(count, 1.7)], axis=1)


def up_error(world: World, found: Georeference) -> float:
    """Degrees between the true up and +z of the scene."""
    up = found.similarity.rotation @ world.truth.rotation.T @ DOWN
    return float(np.rad2deg(np.arctan2(np.hypot(up[0], up[1]), up[2])))  # exact near 0, as arccos is not


@pytest.mark.parametrize("seed", range(5))
def test_any_similarity_comes_back_without_noise(seed: int) -> None:
    world = World(centred(walk()), tilt=15, seed=seed)
    found = world.solve(world.fixes(), world.attitudes())
    assert (found.frame, found.metric, found.notes) == ("enu", True, ())
    assert np.abs(world.errors(found)).max() < 1e-6
    assert found.similarity.scale == pytest.approx(world.truth.scale, rel=1e-8)
    assert found.gps is not None
    assert (found.gps.fixes.cameras, len(found.gps.inliers), found.gps.inliers.sum()) == (60, 60, 60)
    assert found.gps.residual < 1e-6
    assert 0.03 < found.gps.uncertainty < 0.08  # half of the accuracy, however well the fixes agree
    assert found.gps.vertical is not None
    assert found.gps.vertical < 1e-6
    assert np.abs(found.similarity.points(world.sfm_centers)).max() < 200  # small coordinates
    again = world.solve(world.fixes(), world.attitudes())
    assert again.similarity.rotation.tobytes() == found.similarity.rotation.tobytes()


@pytest.mark.parametrize("seed", range(5))
def test_noise_and_outliers(seed: int) -> None:
    """3 m of noise along each axis, 6 m in heights, a fifth of the fixes wrong, over 200 m of way."""
    world = World(walk(), tilt=8, seed=seed)
    found = world.solve(world.fixes(noise=3, vertical=6, wrong=0.2), world.attitudes())
    assert found.frame == "enu"
    assert "do not fit and are left out" in found.notes[0]
    errors = world.errors(found)
    assert np.linalg.norm(errors[:, :2], axis=1).max() < 4.0
    assert np.abs(errors[:, 2]).max() < 4.0
    assert found.similarity.scale / world.truth.scale == pytest.approx(1, abs=0.03)
    assert found.gps is not None
    assert 44 <= found.gps.inliers.sum() <= 52
    assert 2.5 < found.gps.residual < 6
    assert 40 < found.gps.spread < 70
    assert abs(found.similarity.scale / world.truth.scale - 1) < found.gps.uncertainty < 0.15
    assert up_error(world, found) < 0.1


def test_a_straight_way_stays_level() -> None:
    """Heights that are 10 m off would turn it about itself, were up not known from the cameras."""
    world = World(line(), tilt=5)
    found = world.solve(world.fixes(noise=2, vertical=10), world.attitudes())
    assert found.frame == "enu"
    assert up_error(world, found) < 0.1
    assert np.linalg.norm(world.errors(found)[:, :2], axis=1).max() < 3


@pytest.mark.parametrize("tilt", [0.0, 5.0, 12.0])
def test_levelled_by_how_cameras_are_held(tilt: float) -> None:
    world = World(walk(), tilt=tilt)
    found = world.solve()
    assert (found.frame, found.metric, found.gps) == ("upright", False, None)
    assert (found.up.source, found.up.cameras) == ("cameras", 60)
    assert found.up.spread == pytest.approx(1.18 * tilt, rel=0.3)
    assert up_error(world, found) < max(0.3 * tilt, 1e-6)
    assert found.similarity.scale == 1
    assert np.abs(found.similarity.points(world.sfm_centers).mean(axis=0)).max() < 1e-9


def test_levelled_by_attitudes_with_outliers() -> None:
    """Every fourth file is wrong, and every fourth has none."""
    world = World(walk(), tilt=20)
    attitudes = world.attitudes()
    attitudes[::4] = [Attitude(None, 60.0, 90.0)] * 15
    attitudes[1::4] = [None] * 15
    found = world.solve(attitudes=attitudes)
    assert (found.up.source, found.up.cameras) == ("files", 45)
    assert up_error(world, found) < 0.5


def test_attitudes_that_contradict_the_poses() -> None:
    """Panoramas that were levelled later, their files not."""
    world = World(walk())
    world.angles = world.random.uniform(-40, 40, (60, 2))
    found = world.solve(attitudes=world.attitudes())
    assert found.up.source == "cameras"
    assert up_error(world, found) < 1e-6
    assert "60 files differ from the poses by" in found.notes[0]


@pytest.mark.parametrize("noise", [0.0, 8.0])
def test_north_is_where_the_headings_say(noise: float) -> None:
    world = World(walk(40), tilt=4, seed=5)
    compass = world.headings + world.random.normal(0, noise, 40)
    compass[::5] += 90  # next to iron
    attitudes = world.attitudes((compass % 360).tolist())
    found = world.solve(attitudes=attitudes)
    assert found.frame == "upright"
    off = found.similarity.rotation @ world.truth.rotation.T
    angle = np.degrees(np.linalg.norm(Rotation.from_matrix(off).as_rotvec()))
    assert angle < (0.01 if not noise else 4)
    assert any("y is north by the headings in 40 files" in note for note in found.notes)
    assert len(world.solve(world.fixes(), attitudes).notes) == 0  # GPS knows better


@pytest.mark.parametrize("headings", ["same", "random", "few"])
def test_headings_that_say_nothing_are_not_used(headings: str) -> None:
    world = World(walk(40), tilt=4, seed=6)
    written: Sequence[float | None] = {
        "same": [0.0] * 40,
        "random": world.random.uniform(0, 360, 40).tolist(),
        "few": [*world.headings[:2].tolist(), *[None] * 38],
    }[headings]
    found = world.solve(attitudes=world.attitudes(written))
    without = world.solve(attitudes=world.attitudes())
    np.testing.assert_array_equal(found.similarity.rotation, without.similarity.rotation)
    assert not found.notes


def test_cameras_turned_at_random_are_not_levelled() -> None:
    world = World(walk())
    world.sfm_rotations = Rotation.random(60, random_state=1).as_matrix()
    found = world.solve()
    assert found.frame == "arbitrary"
    assert found.up.spread > 50
    assert "not levelled" in found.notes[0]
    assert np.allclose(found.similarity.rotation, np.eye(3))


def test_gps_levels_what_cameras_do_not() -> None:
    """Over an area, with good heights."""
    t = np.linspace(0, 2 * np.pi, 60)
    world = World(np.stack([80 * np.cos(t), 50 * np.sin(2 * t), 5 * np.sin(3 * t)], axis=1))
    world.sfm_rotations = Rotation.random(60, random_state=1).as_matrix()
    found = world.solve(world.fixes(noise=1, vertical=2, wrong=0.1))
    assert found.frame == "enu"
    assert np.linalg.norm(world.errors(found), axis=1).max() < 4
    assert up_error(world, found) < 2


def test_gps_does_not_level_a_straight_way() -> None:
    world = World(line())
    world.sfm_rotations = Rotation.random(40, random_state=1).as_matrix()
    found = world.solve(world.fixes(noise=1, vertical=3))
    assert found.frame == "arbitrary"
    assert "does not determine which way is up" in found.notes[1]


def test_one_spot_is_not_enough() -> None:
    """A receiver that names one place for all, and one that trembles around it."""
    world = World(walk(length=20))
    still = fixes(np.tile([10.0, 20.0, 2.0], (60, 1)))
    trembling = fixes(world.random.normal(0, 2, (60, 3)))
    for found, start in (
        (world.solve(still), "GPS of 60 panoramas spreads over 0.0 m at 1 different places, fewer than 4"),
        (world.solve(trembling), "GPS of 60 panoramas spreads over"),
    ):
        assert (found.frame, found.metric, found.gps) == ("upright", False, None)
        assert found.notes[0].startswith(start)
        assert found.notes[0].endswith(": not used")
        assert up_error(world, found) < 1e-6


def test_fixes_that_repeat() -> None:
    """A receiver that answers for every fifth panorama, and then hangs for the last fifteen."""
    world = World(walk(100))
    enu = world.centers[np.arange(100) // 5 * 5]
    enu[85:] = enu[85]
    found = world.solve(fixes(enu))
    assert found.frame == "enu"
    assert found.gps is not None
    assert (found.gps.fixes.cameras, len(found.gps.inliers)) == (100, 18)
    assert np.linalg.norm(world.errors(found)[:, :2], axis=1).max() < 6  # fixes are up to 8 m late


def test_few_fixes_and_none_with_altitude() -> None:
    world = World(walk())
    sparse: list[GpsFix | None] = [None] * 60
    for row in range(0, 60, 12):
        sparse[row] = replace(fixes(world.centers)[row], altitude=None)
    found = world.solve(sparse)
    assert found.frame == "enu"
    assert found.gps is not None
    assert (len(found.gps.inliers), found.gps.vertical) == (5, None)
    moved = found.similarity.points(world.sfm_centers)
    assert abs(np.median(moved[::12, 2])) < 1e-9
    assert found.gps.fixes.cameras == 5
    away = (found.similarity.points(found.gps.fixes.places(world.sfm_centers)) - found.gps.fixes.enu)[:, :2]
    assert np.linalg.norm(away, axis=1).max() < 1e-3  # metres: the earth is round, and altitude is not known
    sparse[12:48] = [None] * 36
    assert world.solve(sparse).frame == "upright"


def test_across_the_date_line() -> None:
    world = World(walk())
    found = world.solve(fixes(world.centers, (-16.8, 179.9999, 10.0)))
    assert found.frame == "enu"
    assert found.gps is not None
    assert found.gps.residual < 1e-3
    assert found.gps.inliers.sum() == 60


def test_known_scale_holds_against_gps() -> None:
    world = World(walk())
    names = [f"{row}.jpg" for row in range(60)]
    metres = float(np.linalg.norm(world.centers[3] - world.centers[50]))
    scale = scale_from_distance(names, world.sfm_centers, "3.jpg", "50.jpg", metres)
    assert scale == pytest.approx(world.truth.scale, rel=1e-9)
    found = world.solve(scale=scale)
    assert (found.frame, found.metric) == ("upright", True)
    assert found.similarity.scale == scale
    stretched = fixes(world.centers * [1.02, 1.02, 1])
    held = world.solve(stretched, scale=scale)
    assert held.frame == "enu"
    assert held.similarity.scale == pytest.approx(scale, rel=1e-12)
    assert world.solve(stretched).similarity.scale == pytest.approx(1.02 * scale, rel=1e-3)


@pytest.mark.parametrize(
    ("first", "second", "metres", "problem"),
    [
        ("a", "x", 1.0, "x has no pose"),
        ("a", "a", 1.0, "same place"),
        ("a", "c", 1.0, "same place"),
    ],
)
def test_distances_that_give_no_scale(first: str, second: str, metres: float, problem: str) -> None:
    centers = np.array([[0.0, 0, 0], [1, 0, 0], [0, 0, 0]])
    with pytest.raises(InputError, match=problem):
        scale_from_distance(["a", "b", "c"], centers, first, second, metres)


def test_two_cameras_at_one_place() -> None:
    """The least there is: nothing breaks."""
    found = georeference(np.stack([LEVEL, LEVEL]), np.zeros((2, 3)), [None] * 2, fixes(np.eye(2, 3) * 50))
    assert found.frame == "upright"
    assert np.abs(found.similarity.points(np.zeros((1, 3)))).max() == 0
    same = georeference(np.stack([LEVEL] * 5), np.zeros((5, 3)), [None] * 5, fixes(np.eye(5, 3) * 50))
    assert "not used" in same.notes[0]
