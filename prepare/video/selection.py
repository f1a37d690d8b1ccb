"""Which frames of a video to extract, given how far the camera has moved in each."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from panolog.prepare.video.motion import Piece

_NEAR = 0.2  # baselines from the even spacing where a frame may be
_FAR = 0.4  # where it may be if all nearer ones are blurred
_BLURRED = 0.5  # of the best sharpness within _FAR
_NEARLY = 0.8  # of the best sharpness is enough: then the most even frame is taken
_ALIKE = 0.1  # baselines farther from its place than the best one: of these the one that is decoded first
_WIDEN = 1.03  # factor of the step, repeated until there are few enough


def choose_frames(
    pieces: Sequence[Piece], parallax: float, most: int | None, keys: Sequence[float] = ()
) -> list[int]:
    """The numbers, ascending, of frames about `parallax` degrees apart, both ends of each piece included.

    Each piece is divided evenly. If that gives more than `most`, the step is increased for all pieces.

    Args: keys, seconds of the frames from which decoding can begin: of frames that are as good, that is taken
        which is the fewest seconds after one.
    """
    step = parallax
    steps = [_steps(piece, step) for piece in pieces]
    while most is not None and any(steps) and sum(steps) + len(pieces) > most:
        step *= _WIDEN
        steps = [_steps(piece, step) for piece in pieces]
    chosen = sorted({number for piece in pieces for number in _divide(piece, step, keys)})
    if most is not None and len(chosen) > most:  # more pieces than that, each with a frame at least
        chosen = [chosen[row] for row in np.linspace(0, len(chosen) - 1, most).round().astype(int)]
    return chosen


def _steps(piece: Piece, step: float) -> int:
    """Baselines between the ends of a piece."""
    return round(max(piece.positions) / step)


def _divide(piece: Piece, step: float, keys: Sequence[float]) -> list[int]:
    """Frames of a piece at even distances of about `step` degrees; the sharpest one where it hardly moves."""
    positions, sharpness = np.array(piece.positions), np.array(piece.sharpness)
    count = _steps(piece, step)
    if count == 0:
        return [piece.frames[int(sharpness.argmax())]]
    even = positions.max() / count
    times, late = np.array(piece.times), np.zeros(len(piece.times))  # seconds after the last of the keys
    if len(keys):
        late = times - np.array(keys)[np.maximum(np.searchsorted(keys, times, side="right") - 1, 0)]
    rows = [_best(np.abs(positions / even - place), sharpness, late) for place in range(count + 1)]
    return [piece.frames[row] for row in rows]


def _best(away: NDArray[np.float64], sharpness: NDArray[np.float64], late: NDArray[np.float64]) -> int:
    """The row of the frame to take.

    Args: away (N,) baselines from its place, sharpness (N,), late (N,) seconds after a frame from which
        decoding can begin.
    """
    around, near = away <= _FAR, away <= _NEAR
    if not around.any():
        return int(away.argmin())
    if not near.any() or sharpness[near].max() < _BLURRED * sharpness[around].max():
        near = around
    good = near & (sharpness >= _NEARLY * sharpness[near].max())
    good = np.flatnonzero(good & (away <= away[good].min() + _ALIKE))
    return int(good[np.lexsort((away[good], late[good]))[0]])
