"""Pictures that are no panoramas differ from those that are."""

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from panolog.scene.pictures.kinds import describe_picture
from tests.data import shared

SIDE = 128
Grey = NDArray[np.uint8]


def drawn(seed: int) -> Grey:
    """(2 SIDE, 4 SIDE) a panorama of coarse structures on light and dark ground, which fade to the poles."""
    random = np.random.default_rng(seed)
    coarse = random.normal(0, 60, (12, 24)).astype(np.float32)
    coarse *= np.cos(np.linspace(-1.5, 1.5, 12))[:, None]
    wide = cv2.resize(np.hstack([coarse] * 3), (12 * SIDE, 2 * SIDE))[:, 4 * SIDE : 8 * SIDE]
    return np.asarray((wide + np.linspace(190, 90, 2 * SIDE)[:, None]).clip(0, 255), np.uint8)


def circle(panorama: Grey, *, back: bool = False, radius: float = 1.0, light: int = 0) -> Grey:
    """(SIDE, SIDE) what a lens of 200 degrees sees of a panorama (H, 2 H), with stray light around."""
    y, x = ((np.mgrid[:SIDE, :SIDE] + 0.5) / SIDE * 2 - 1) / radius
    r, turn = np.hypot(x, y), np.arctan2(y, x)
    away = r * np.radians(100)
    d = np.stack([np.sin(away) * np.cos(turn), np.sin(away) * np.sin(turn), np.cos(away)], -1)
    d *= (-1, 1, -1) if back else 1
    height, width = panorama.shape
    u = (np.arctan2(d[..., 0], d[..., 2]) / (2 * np.pi) + 0.5) * width
    v = (np.arcsin(d[..., 1].clip(-1, 1)) / np.pi + 0.5) * height
    seen = cv2.remap(
        panorama, u.astype(np.float32), v.astype(np.float32), cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP
    )
    return np.where(r <= 1, seen, light).astype(np.uint8)


@pytest.mark.parametrize("seed", range(5))
def test_a_panorama_and_what_else_the_same_place_looks_like(seed: int) -> None:
    tell_apart(drawn(seed))


@pytest.mark.parametrize("place", ["street", "flat", "school"])
def test_photographs(place: str) -> None:
    for path in sorted((shared(place) / "images").iterdir()):
        grey = np.asarray(cv2.imread(str(path), cv2.IMREAD_GRAYSCALE), np.uint8)
        tell_apart(np.asarray(cv2.resize(grey, (4 * SIDE, 2 * SIDE), interpolation=cv2.INTER_AREA), np.uint8))


def tell_apart(panorama: Grey) -> None:
    assert describe_picture(panorama) is None
    for radius, light in ((1.0, 0), (0.92, 12), (1.04, 5)):
        lenses = [circle(panorama, back=back, radius=radius, light=light) for back in (False, True)]
        for both in (np.hstack(lenses), np.vstack(lenses)):
            assert "two fisheye circles; stitch it in" in (describe_picture(both) or "")
        assert "one fisheye circle; stitch it in" in (describe_picture(lenses[0]) or "")
    front = panorama[:, SIDE : 3 * SIDE]
    eyes = np.hstack([front, np.roll(front, 2, axis=1)])  # by 1.4 degrees: what is 2.6 m away
    assert "two eyes side by side" in (describe_picture(eyes) or "")
    above = np.vstack([panorama, np.roll(panorama, 2, axis=1)])
    assert "one above the other" in (describe_picture(above) or "")


def test_pictures_that_are_not_taken_for_anything_else() -> None:
    """Plain ones, the night, and light that rises and falls twice: front and back differ in details."""
    night = np.zeros((2 * SIDE, 4 * SIDE), np.uint8)
    night[SIDE - 30 : SIDE + 30] = np.random.default_rng(0).integers(0, 255, (60, 4 * SIDE))
    light = 120 + 45 * np.sin(np.arange(4 * SIDE) * 2 * np.pi / SIDE / 2)
    noise = np.random.default_rng(0).normal(0, 4, (2 * SIDE, 4 * SIDE))
    twice = (light + noise).clip(0, 255).astype(np.uint8)
    plain = [np.full(shape, 90, np.uint8) for shape in ((32, 64), (64, 64), (64, 32), (1, 2), (48, 64))]
    assert [describe_picture(picture) for picture in (night, twice, *plain, 0 * plain[0])] == [None] * 8
