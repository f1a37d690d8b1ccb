"""How far a camera has come in each frame, and which frames are taken for it."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from panolog.prepare.video.motion import MotionTracker, Piece, sharpness
from panolog.prepare.video.selection import Choice, choose_frames
from tests.prepare.video.videos import HEIGHT, WIDTH, Image, Shot, render, turn, walk

pytestmark = pytest.mark.system

PARALLAX = 5.0


def grey(picture: Image) -> NDArray[np.uint8]:
    """(H, W) of (H, W, 3) BGR."""
    return np.asarray(cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY), np.uint8)


def motion(shots: list[Shot]) -> list[Piece]:
    """What is found in rendered shots, without a codec in between."""
    found = MotionTracker(WIDTH)
    for number, shot in enumerate(shots):
        found.add(number, number / 30, grey(render(shot)))
    return found.finish()


def test_equal_steps_are_equal_parallax_and_turns_are_none() -> None:
    moving = walk([0.1] * 12)
    (piece,) = motion([*moving, *turn(moving[-1], np.arange(0.0, 360.0, 12.0))])
    assert len(piece.frames) == 42
    steps = np.diff(piece.positions)
    assert steps[:11].std() < 0.2 * steps[:11].mean()
    assert np.abs(steps[11:]).max() < 0.3


def test_a_whip_turn_too_blurred_to_follow_is_no_motion() -> None:
    start = Shot(0.0)
    smeared = [replace(it, blur=40.0) for it in turn(start, np.arange(25.0, 150.0, 25.0))]
    pieces = motion([start] * 3 + smeared + [replace(start, turn=(150.0, 0.0, 0.0))] * 3)
    assert len(pieces) == 1
    assert max(pieces[0].positions) < 0.5


def test_what_moves_by_itself_is_no_motion() -> None:
    (piece,) = motion([Shot(0.0, mover=float(it * 6)) for it in range(25)])
    assert len(piece.frames) == 25
    assert max(piece.positions) < 0.5


def test_a_cut_begins_anew_and_both_ends_of_it_are_there() -> None:
    first, second = walk([0.15] * 10), walk([0.15] * 10, start=400.0)
    pieces = motion([*first, *second])
    assert [len(piece.frames) for piece in pieces] == [10, 10]
    chosen = choose_frames(pieces, PARALLAX, None)
    assert {0, 10} <= {number // 2 * 2 for number in chosen}
    assert any(number in (8, 9) for number in chosen) and any(number in (18, 19) for number in chosen)


def test_of_a_time_lapse_every_frame_is_there() -> None:
    pieces = motion([Shot(along) for along in np.arange(6) * 37.0])
    assert choose_frames(pieces, PARALLAX, None) == list(range(6))


def test_flashes_and_black_frames_are_left_out() -> None:
    found = MotionTracker(WIDTH)
    for number, shot in enumerate(walk([0.1] * 16)):
        white = np.full((HEIGHT, WIDTH, 3), 255, np.uint8)
        picture = {0: 0 * white, 5: white, 9: 0 * white, 10: 0 * white}.get(number, render(shot))
        found.add(number, number / 30, grey(picture))
    (piece,) = found.finish()
    assert set(range(16)).difference(piece.frames) == {0, 5, 9, 10}


def test_sharpness_is_that_of_the_picture_not_of_its_exposure_or_orientation() -> None:
    shots = (Shot(0.0), Shot(0.0, (70.0, 0.0, 0.0)), Shot(0.0, blur=1.5))
    pictures = [grey(render(shot, bearer=False)) for shot in shots]
    here, turned, blurred = map(sharpness, pictures)
    assert turned == pytest.approx(here, rel=0.1)
    assert blurred < 0.5 * here
    assert sharpness(np.asarray(pictures[0] // 2, np.uint8)) == pytest.approx(here, rel=0.1)
    assert sharpness(np.zeros((HEIGHT, WIDTH), np.uint8)) == 0


@pytest.mark.parametrize("most", [2, 3, 7, 20, 40])
def test_fewer_frames_are_as_even(most: int) -> None:
    piece = Piece(list(range(1000)), [0.0] * 1000, list(np.linspace(0, 200, 1000)), [1.0] * 1000)
    chosen = choose_frames([piece], PARALLAX, most)
    assert most * 0.9 - 1 <= len(chosen) <= most
    assert (chosen[0], chosen[-1]) == (0, 999)
    assert max(np.diff(chosen)) <= 1.05 * min(np.diff(chosen))


def test_more_pieces_than_frames_wanted() -> None:
    pieces = [Piece([number], [0.0], [0.0], [1.0]) for number in range(50)]
    assert choose_frames(pieces, PARALLAX, 5) == [0, 12, 24, 37, 49]


def test_a_blurred_stretch_is_stepped_over() -> None:
    positions = np.arange(0, 20.5, 0.25)
    blurred = (positions > 8.9) & (positions < 11.1)  # around the third place, 10 degrees
    rows = list(range(len(positions)))
    piece = Piece(rows, [0.0] * len(rows), positions.tolist(), np.where(blurred, 0.1, 1.0).tolist())
    chosen = choose_frames([piece], PARALLAX, None)
    assert len(chosen) == 5 and not blurred[chosen].any()


def test_steps_begin_anew_after_a_gap_and_both_ends_are_there() -> None:
    """A large video has such gaps, where frames before one from which decoding can begin are left out."""
    positions = [begin + it for begin in range(0, 90, 9) for it in np.arange(0.0, 4.6, 0.5)]
    rows = list(range(len(positions)))
    chosen = choose_frames([Piece(rows, [0.0] * len(rows), positions, [1.0] * len(rows))], 4.0, None)
    assert (chosen[0], chosen[-1]) == (0, rows[-1])
    steps = np.diff([positions[row] for row in chosen])
    assert steps.min() >= 2.4 and steps.max() <= 5.6


def test_while_frames_come_the_same_are_chosen_but_for_the_end() -> None:
    random = np.random.default_rng(0)
    positions = np.cumsum(random.uniform(0, 2, 300))
    choice, early = Choice(PARALLAX), list[int]()
    for row, position in enumerate(positions):
        done = choice.add(row, float(position), float(random.uniform(0.2, 1.0)))
        early += [] if done is None else [done]
        assert done is None or positions[done] > position - 1.8 * PARALLAX
    assert set(choice.finish()) - set(early) <= choice.open
    assert early == choice.finish()[: len(early)] or early[:-1] == choice.finish()[: len(early) - 1]
