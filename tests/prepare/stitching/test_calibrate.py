"""Lenses found from the pictures alone are those of a camera that is known."""

from dataclasses import replace
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest

from panolog.prepare.stitching.calibrate import OverlapError, calibrate, disagreement
from panolog.prepare.stitching.circles import CircleError, Picture, find_circle, halves
from panolog.prepare.stitching.light import gains
from panolog.prepare.stitching.pictures import lenses_in
from panolog.prepare.stitching.stitch import Stitcher
from panolog.scene.image_files import decode_colors
from tests.data import shared
from tests.prepare.stitching.cameras import Camera, camera, errors
from tests.prepare.video.videos import Shot, render

pytestmark = pytest.mark.system

SMALL, WIDTH = 1024, 2048  # of panoramas of lenses whose pictures have half of that


@cache
def panoramas(count: int) -> list[Picture]:
    """Panoramas of a street; nothing in it counts as near, as both lenses are at one place."""
    return [render(Shot(7.3 * number), SMALL, bearer=False) for number in range(count)]


def taken(known: Camera, views: list[Picture]) -> list[tuple[Picture, Picture]]:
    return [halves(known.picture(view, seed)) for seed, view in enumerate(views)]


@pytest.mark.parametrize("turned", [0.0, 90.0, 178.0])
def test_the_lenses_are_found(turned: float) -> None:
    known = camera(512, turned=turned)
    found = calibrate(taken(known, panoramas(4)))
    off, apart = errors(known, found, SMALL)
    assert np.sqrt((off**2).mean()) < 1.0 and off.max() < 2.0
    assert np.sqrt((apart**2).mean()) < 0.3 and apart.max() < 0.8
    assert found.size == (512, 512) and abs(np.rad2deg(found.reach) - 98.5) < 1


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
    pictures = taken(known, views)
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
    known = camera(512)
    views = panoramas(4)
    pictures = taken(known, views)
    found = calibrate(pictures)
    stitched = Stitcher(found, SMALL).panorama(pictures[0])
    assert stitched.shape == (512, 1024, 3)
    single = Stitcher(found, SMALL).joined(pictures[0])
    assert decibels(stitched, views[0]) > decibels(single, views[0]) + 1  # 20 % of brightness at the seam
    turned = calibrate(taken(camera(512, turned=90), views))
    again = Stitcher(turned, SMALL).panorama(taken(camera(512, turned=90), views[:1])[0])
    assert decibels(again, stitched) > 30  # how a circle is turned does not matter


@pytest.mark.parametrize(("rim", "steep"), [(1.0, 1), (0.8, 1), (0.6, 1), (0.6, 2)])
def test_the_fall_off_of_light_is_found_and_taken_back(rim: float, steep: int) -> None:
    views = panoramas(4)
    pictures = taken(camera(512, rim=rim, steep=steep), views)
    found = lenses_in(Path("folder"), (512, 512), pictures)
    outer = np.linspace(0, 1, 20)
    true = np.cos(outer**steep * np.arccos(rim**0.25)) ** 4
    light = found.light(outer * np.deg2rad(98.5))
    assert np.allclose(light, true, atol=0.04) and (np.diff(light) <= 0).all()
    assert np.allclose(gains(found, pictures[0]), 1.2, atol=0.02)
    if rim < 1:
        lifted, dark = (Stitcher(it, SMALL).panorama(pictures[0]) for it in (found, replace(found, fall=())))
        assert decibels(lifted, views[0]) > decibels(dark, views[0]) + 1.5


def test_what_is_near_is_left_out_of_the_fit() -> None:
    """A third of the ring is 4 cm from one lens to the other, 60 cm away: as an operator's hand."""
    known, views = camera(512), panoramas(4)
    pictures = taken(known, views)
    moved = []
    for one, other in pictures:
        near = other.copy()
        near[340:] = cv2.warpAffine(other, np.array([[1.0, 0, 0], [0, 1.0, 9.0]]), (512, 512))[340:]
        moved.append((one, near))
    _, apart = errors(known, calibrate(moved), SMALL)
    assert np.median(apart) < 1.0


def test_a_picture_of_another_camera_disagrees() -> None:
    known, views = camera(512), panoramas(4)
    found = calibrate(taken(known, views))
    (same,), (other,) = taken(known, views[:1]), taken(camera(512, tilt=3.5), views[:1])
    fits, fails = disagreement(found, same), disagreement(found, other)
    assert fits is not None and fits < 0.1
    assert fails is None or fails > 0.5


def test_circles_are_found_to_a_fraction_of_a_pixel() -> None:
    known = camera(512)
    pictures = taken(known, panoramas(2))
    for side, lens in enumerate(known.lenses):
        circle = find_circle([both[side] for both in pictures])
        assert np.hypot(circle.x - lens.centre[0], circle.y - lens.centre[1]) < 0.3


def test_what_is_no_circle_is_refused() -> None:
    with pytest.raises(CircleError, match="no dark surrounding"):
        find_circle([panoramas(1)[0][:, :512]])
    with pytest.raises(CircleError, match="no circle"):
        square = np.zeros((256, 256, 3), np.uint8)
        square[40:216, 8:248] = 200
        find_circle([square])
    one, _ = taken(camera(512), panoramas(1))[0]
    with pytest.raises(CircleError, match="cut off: it ends after 23% of its radius"):
        find_circle([one[:, 200:]])


def test_an_overlap_without_texture_is_refused() -> None:
    plain = np.full((512, 1024, 3), 130, np.uint8)
    plain[:, 462:562] = panoramas(1)[0][:, 462:562]  # ahead, but not around
    with pytest.raises(OverlapError, match=r"too little texture: \d+ points in \d+ of 12 parts"):
        calibrate(taken(camera(512), [plain]))
