"""Lenses found from the pictures alone are those of a camera that is known."""

from dataclasses import replace
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest

from panolog.prepare.stitching.calibrate import OverlapError, calibrate, disagreement
from panolog.prepare.stitching.circles import CircleError, Picture, find_circle, halves
from panolog.prepare.stitching.lenses import Pair
from panolog.prepare.stitching.light import gains
from panolog.prepare.stitching.pictures import lenses_in
from panolog.prepare.stitching.stitch import Stitcher
from panolog.scene.image_files import decode_colors
from tests.data import shared
from tests.prepare.stitching.cameras import Camera, camera, errors
from tests.prepare.video.videos import Shot, render

pytestmark = pytest.mark.system

SIZE, SMALL, WIDTH = 400, 800, 2048  # of a lens's picture, and of panoramas
KNOWN, TURNED = camera(SIZE), camera(SIZE, turned=90)


@cache
def panoramas(count: int = 2) -> list[Picture]:
    """Panoramas of a street; nothing in it counts as near, as both lenses are at one place."""
    return [render(Shot(7.3 * number), SMALL, bearer=False) for number in range(count)]


@cache
def taken(known: Camera, count: int = 2) -> list[tuple[Picture, Picture]]:
    """Both circles of each of the panoramas."""
    return pictures_of(known, panoramas(count))


def pictures_of(known: Camera, views: list[Picture]) -> list[tuple[Picture, Picture]]:
    return [halves(known.picture(view, seed)) for seed, view in enumerate(views)]


@cache
def found_of(known: Camera) -> Pair:
    return calibrate(taken(known))


@pytest.mark.parametrize("known", [KNOWN, TURNED, camera(SIZE, turned=178)], ids=["0", "90", "178"])
def test_the_lenses_are_found(known: Camera) -> None:
    found = found_of(known)
    off, apart = errors(known, found, SMALL)
    assert np.sqrt((off**2).mean()) < 0.6 and off.max() < 1.5
    assert np.sqrt((apart**2).mean()) < 0.25 and apart.max() < 0.6
    assert found.size == (SIZE, SIZE) and abs(np.rad2deg(found.reach) - 98.5) < 1


@pytest.mark.nightly
def test_on_a_street_at_full_size() -> None:
    files = sorted((shared("street") / "images").iterdir())[::11]
    views = [
        np.asarray(
            cv2.resize(decode_colors(it), (WIDTH, WIDTH // 2), interpolation=cv2.INTER_CUBIC), np.uint8
        )
        for it in files
    ]
    known = camera(1024)
    pictures = pictures_of(known, views)
    found = calibrate(pictures)
    off, apart = errors(known, found, WIDTH)
    print(f"\noverlap: {off.max():.2f} max, {np.sqrt((off**2).mean()):.2f} rms; apart {apart.max():.2f} max")
    assert off.max() < 1.0 and apart.max() < 0.25
    assert np.allclose(gains(found, pictures[0]), 1.2, atol=0.01)
    stitched = Stitcher(found, WIDTH).panorama(pictures[0])
    assert decibels(stitched, views[0]) > 32


def decibels(picture: Picture, truth: Picture) -> float:
    """PSNR after a fit of the brightness, which is that between the two lenses."""
    one, other = picture.astype(float), truth.astype(float)
    one *= (one * other).sum() / (one * one).sum()
    return float(10 * np.log10(255**2 / ((one - other) ** 2).mean()))


def test_the_panorama_is_the_true_one_and_even() -> None:
    pictures, found, (view, _) = taken(KNOWN), found_of(KNOWN), panoramas()
    stitched = Stitcher(found, SMALL).panorama(pictures[0])
    assert stitched.shape == (SMALL // 2, SMALL, 3)
    single = Stitcher(found, SMALL).joined(pictures[0])
    assert decibels(stitched, view) > decibels(single, view) + 1  # 20 % of brightness at the seam
    again = Stitcher(found_of(TURNED), SMALL).panorama(taken(TURNED)[0])
    assert decibels(again, stitched) > 30  # how a circle is turned does not matter


@pytest.mark.parametrize(("rim", "steep"), [(1.0, 1), (0.6, 1), (0.6, 2)])
def test_the_fall_off_of_light_is_found_and_taken_back(rim: float, steep: int) -> None:
    known, (view, _) = camera(SIZE, rim=rim, steep=steep), panoramas()
    pictures = taken(known, 2 * steep)  # what is steep at the rim is seen by points found again and again
    found = lenses_in(Path("folder"), (SIZE, SIZE), pictures)
    outer = np.linspace(0, 1, 20)
    true = np.cos(outer**steep * np.arccos(rim**0.25)) ** 4
    light = found.light(outer * np.deg2rad(98.5))
    assert np.allclose(light, true, atol=0.04) and (np.diff(light) <= 0).all()
    assert np.allclose(gains(found, pictures[0]), 1.2, atol=0.02)
    if rim < 1:
        lifted, dark = (Stitcher(it, SMALL).panorama(pictures[0]) for it in (found, replace(found, fall=())))
        assert decibels(lifted, view) > decibels(dark, view) + 1.5


def test_what_is_near_is_left_out_of_the_fit() -> None:
    """A third of the ring is 4 cm from one lens to the other, 60 cm away: as an operator's hand."""
    moved, first = [], 2 * SIZE // 3
    for one, other in taken(KNOWN):
        near = other.copy()
        near[first:] = cv2.warpAffine(other, np.array([[1.0, 0, 0], [0, 1.0, 7.0]]), (SIZE, SIZE))[first:]
        moved.append((one, near))
    _, apart = errors(KNOWN, calibrate(moved), SMALL)
    assert np.median(apart) < 1.0


def test_a_picture_of_another_camera_disagrees() -> None:
    fits, fails = (disagreement(found_of(KNOWN), taken(it)[0]) for it in (KNOWN, camera(SIZE, tilt=3.5)))
    assert fits is not None and fits < 0.1
    assert fails is None or fails > 0.5


def test_circles_are_found_to_a_fraction_of_a_pixel() -> None:
    for side, lens in enumerate(KNOWN.lenses):
        circle = find_circle([both[side] for both in taken(KNOWN)])
        assert np.hypot(circle.x - lens.centre[0], circle.y - lens.centre[1]) < 0.3


def test_what_is_no_circle_is_refused() -> None:
    with pytest.raises(CircleError, match="no dark surrounding"):
        find_circle([panoramas()[0][:, :SIZE]])
    with pytest.raises(CircleError, match="no circle"):
        square = np.zeros((256, 256, 3), np.uint8)
        square[40:216, 8:248] = 200
        find_circle([square])
    one, _ = taken(KNOWN)[0]
    with pytest.raises(CircleError, match="cut off: it ends after 23% of its radius"):
        find_circle([one[:, 156:]])


def test_an_overlap_without_texture_is_refused() -> None:
    plain = np.full((SMALL // 2, SMALL, 3), 130, np.uint8)
    plain[:, 361:439] = panoramas()[0][:, 361:439]  # ahead, but not around
    with pytest.raises(OverlapError, match=r"too little texture: \d+ points in \d+ of 12 parts"):
        calibrate(pictures_of(KNOWN, [plain]))
