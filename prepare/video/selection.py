"""Which frames of a video to look at, to follow its motion in a first pass, and which of them to choose."""

import math
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import av
import numpy as np
from numpy.typing import NDArray

from panolog.prepare.stitching.lenses import Up
from panolog.prepare.video.decode import Video, open_video
from panolog.prepare.video.motion import SHARP_WIDTH, MotionTracker, Piece, VideoMotion
from panolog.prepare.video.streams import Effort
from panolog.scene.errors import SceneError
from panolog.scene.pictures.kinds import describe_picture
from panolog.scene.write import Progress

PARALLAX = 4.0  # degrees between neighbours: a metre in a street, a third of it in a room
_DENSE = 0.5  # degrees of parallax between two frames of a large video that are looked at, at most
_LOOSE = PARALLAX / 3  # the same, where `PARALLAX` will do
_COARSE = 1.5 * PARALLAX  # degrees between frames of which those between are not needed
_AROUND = 0.4  # steps from its place where a frame may be
_NEAR = 0.1  # steps from its place at which a frame does not move those that follow
_LEAST = 0.5  # steps between the last two frames of a piece, at least
_WIDEN = 1.03  # factor of the step, repeated until there are few enough

Write = Callable[[int, Video, av.VideoFrame, float], bool]


class _Frame(NamedTuple):
    """A frame that may be chosen."""

    number: int
    position: float  # degrees of parallax since the first of its piece
    merit: float


class Choice:
    """Chooses frames of a piece as they come, about a step from one to the next, and both ends.

    Of the frames around a place, that is chosen whose sharpness is highest, reduced by as many parts as the
    frame is parts of a step from the place. Places are even, and begin anew where no frame is near one.
    """

    def __init__(self, step: float) -> None:
        """Args: step, in degrees of parallax."""
        self._step = step
        self._place = self._end = 0.0  # degrees: the next place, and the farthest frame
        self._chosen: list[_Frame] = []
        self._best: _Frame | None = None  # so far for the next place
        self._last: _Frame | None = None  # the best so far for the end of the piece

    @property
    def open(self) -> set[int]:
        """The numbers of frames that may still be chosen."""
        return {it.number for it in (self._best, self._last) if it is not None}

    def add(self, number: int, position: float, sharpness: float) -> int | None:
        """Adds the next frame; returns the one for which there is no better one any more, if any.

        Args: position, in degrees of parallax since the first.
        """
        done, best, last = None, self._best, self._last
        around = _AROUND * self._step
        if best is not None and position > self._place + around:
            near = abs(best.position - self._place) < _NEAR * self._step
            self._place = self._step + (self._place if near else best.position)
            self._chosen.append(best)
            done, best = best.number, None
        away = (position - self._place) / self._step
        merit = sharpness * max(0.0, 1 - abs(away))
        if away >= -_AROUND and (best is None or merit > best.merit):
            best = _Frame(number, position, merit)
        late = math.log(max(sharpness, 1e-9)) + position / self._step
        if last is None or late >= last.merit or position > last.position + around:
            last = _Frame(number, position, late)
        self._best, self._last = best, last
        self._end = max(self._end, position)
        return done

    def finish(self) -> list[int]:
        """The numbers, ascending, of all chosen frames, if the piece ends here; one where it hardly moves."""
        last = self._last
        if last is None:
            return []
        if self._end < _LEAST * self._step:
            return [last.number]
        found = [*self._chosen, *([] if self._best is None else [self._best])]
        while len(found) > 1 and last.position - found[-1].position < _LEAST * self._step:
            found.pop()
        return sorted({last.number, *(it.number for it in found)})


def choose_frames(pieces: Sequence[Piece], parallax: float, most: int | None) -> list[int]:
    """The numbers, ascending, of frames about `parallax` degrees apart, both ends of each piece included.

    If these are more than `most`, the step is increased for all pieces, and each is divided evenly.
    """
    chosen, step, counts = [_choose(piece, parallax) for piece in pieces], parallax, [1]
    while most is not None and sum(map(len, chosen)) > most and any(counts):
        step *= _WIDEN
        counts = [round(max(piece.positions) / step) for piece in pieces]  # steps in each
        if sum(counts) + len(pieces) <= most or not any(counts):
            even = [max(piece.positions) / n if n else step for piece, n in zip(pieces, counts, strict=True)]
            chosen = [_choose(piece, it) for piece, it in zip(pieces, even, strict=True)]
    found = sorted({number for numbers in chosen for number in numbers})
    if most is not None and len(found) > most:  # more pieces than that, each with a frame at least
        found = [found[row] for row in np.linspace(0, len(found) - 1, most).round().astype(int)]
    return found


def _choose(piece: Piece, step: float) -> list[int]:
    """The chosen frames of a piece."""
    choice = Choice(step)
    for number, position, sharpness in zip(piece.frames, piece.positions, piece.sharpness, strict=True):
        choice.add(number, position, sharpness)
    return choice.finish()


class Early:
    """Writes frames that will be chosen while their video is followed, so that they are decoded once."""

    def __init__(self, parallax: float, write: Write) -> None:
        """Args: parallax, in degrees; write, which writes a frame by its number, the video and its time."""
        self.written: set[int] = set()
        self._parallax, self._write = parallax, write
        self._piece: Piece | None = None
        self._seen = 0  # of its frames
        self._choice = Choice(parallax)
        self._shots: dict[int, tuple[av.VideoFrame, float]] = {}  # of frames that may be chosen

    def restart(self) -> None:
        """Forgets all frames: the video is followed anew."""
        self.written = set()
        self._start(None)

    def see(self, source: Video, pieces: list[Piece]) -> None:
        """Looks at the last frame of `source`, which is that of the last piece if it could be followed."""
        piece = pieces[-1] if pieces else None
        if piece is None or piece.times[-1] != source.time:
            return
        if piece is not self._piece:  # whose first frame may have come before
            self.finish(source)
            self._start(piece)
        number = piece.frames[-1]
        self._shots[number] = source.frame, source.time
        for row in range(self._seen, len(piece.frames)):
            done = self._choice.add(piece.frames[row], piece.positions[row], piece.sharpness[row])
            if done is not None:
                self._save(source, done)
        self._seen = len(piece.frames)
        still = self._choice.open
        self._shots = {number: shot for number, shot in self._shots.items() if number in still}

    def finish(self, source: Video) -> None:
        """Writes the frames at the end of a piece, if the camera moves in it."""
        found = self._choice.finish()
        for number in found if len(found) > 1 else []:
            self._save(source, number)

    def _start(self, piece: Piece | None) -> None:
        self._piece, self._seen, self._choice, self._shots = piece, 0, Choice(self._parallax), {}

    def _save(self, source: Video, number: int) -> None:
        shot = self._shots.pop(number, None)
        if shot is not None and self._write(number, source, *shot):
            self.written.add(number)


class _Way:
    """The motion in a video while it is followed."""

    def __init__(
        self, source: Video, apart: float, often: int, progress: Progress, early: Early | None
    ) -> None:
        """Args: apart, degrees of parallax between frames that are enough; often, every how manieth is."""
        self._motion = MotionTracker(source.width)
        self._apart, self._often, self._progress, self._early = apart, often, progress, early
        self._begin = 0.0  # degrees, position where `follow` began
        if early is not None:
            early.restart()

    def due(self, numbers: Iterator[int]) -> Iterator[int]:
        """The numbers of frames, of `numbers`, that are far enough from the last one."""
        return (number for number in numbers if self._motion.is_due(number, self._apart, self._often))

    def follow(self, source: Video, numbers: Iterator[int]) -> Iterator[int]:
        """Adds the frames of a video that are due, and yields the number of each. Raises SceneError."""
        self._begin = self._position
        for number in self.due(numbers):
            grey = source.grey(SHARP_WIDTH)
            if grey is not None:
                self.add(source, number, grey)
            self.show(source)
            yield number

    def add(self, source: Video, number: int, grey: NDArray[np.uint8]) -> None:
        """Adds the last frame of `source`. Raises SceneError if it is the first one and no panorama."""
        if not self._motion.pieces and (what := describe_picture(grey)) is not None:
            raise SceneError(f"{source.path}: its frames are {what}")
        self._motion.add(number, source.time, grey)
        self._see(source)

    def add_near(self, source: Video, number: int, grey: NDArray[np.uint8]) -> bool:
        """Adds the last frame of `source` unless it is blurred or far; whether it was added."""
        near = self._motion.add_near(number, source.time, grey, _COARSE)
        if near:
            self._see(source)
        return near

    def is_filled(self, number: int) -> bool:
        """Whether frame `number` can come next, at the present pace.

        That is so where `follow` has come to the last place for a frame, of the fewest that divide the way
        from its begin into parts of `_COARSE` or less.
        """
        pace = self._motion.pace
        if pace is None:
            return False
        covered = self._position - self._begin
        rest = pace * (number - self._motion.pieces[-1].frames[-1])
        parts = max(1, math.ceil((covered + rest) / _COARSE))
        return rest <= _COARSE and covered >= (parts - 1) * min(PARALLAX, (covered + rest) / parts)

    def show(self, source: Video) -> None:
        """Shows how far the first of two passes is."""
        self._progress(source.passed, 2 * max(source.promised, source.passed))

    def finish(self, source: Video) -> list[Piece]:
        """All pieces, after the last frame."""
        if self._early is not None:
            self._early.finish(source)
        return self._motion.finish()

    @property
    def _position(self) -> float:
        return self._motion.pieces[-1].positions[-1] if self._motion.pieces else 0.0

    def _see(self, source: Video) -> None:
        if self._early is not None:
            self._early.see(source, self._motion.pieces)


def search(
    video: Path, key: str, progress: Progress, up: Up | None, early: Early | None, *, fine: bool
) -> VideoMotion:
    """The motion in a video, followed again with care if the video turns out to be damaged.

    Args: key, the digest that it gets; fine, for a smaller parallax than `PARALLAX`; early, which sees the
        frames: what it has written is that of the motion.
    Raises SceneError: nothing can be tracked, or as of `open_video`.
    """
    found = None if fine else _coarsely_followed(video, key, progress, up, early)
    found = found or _followed(video, key, progress, "fast", up, early)
    if found is None:
        if early is not None:
            early.restart()
        found = _followed(video, key, progress, "exact", up, None)
    if found is None or not found.pieces:
        raise SceneError(f"{video}: is damaged, or shows nothing that can be tracked; no frame can be used")
    return found


def _coarsely_followed(
    video: Path, key: str, progress: Progress, up: Up | None, early: Early | None
) -> VideoMotion | None:
    """The motion by the frames from which decoding can begin, and by others where these are far apart.

    None of a video that is small or not plain. Raises SceneError.
    """
    with open_video(video, "keys", up) as keys, open_video(video, "fast", up) as source:
        if source.often == 1 or keys.frame.pts != source.frame.pts:
            return None
        way, begin = _Way(source, _LOOSE, source.often, progress, early), None
        for number in way.due(keys.frames()):
            grey = keys.grey(SHARP_WIDTH)
            if grey is None or not keys.is_plain:
                return None
            if not way.add_near(keys, number, grey):
                for _ in way.follow(source, source.between(begin, keys.time)):
                    if way.is_filled(number) and way.add_near(keys, number, grey):
                        break
                else:
                    way.add(keys, number, grey)
            if not source.is_plain:
                return None
            begin = keys.time
            way.show(keys)
        for _ in way.follow(source, source.between(begin, math.inf)):
            pass
        pieces = way.finish(source)
        if not source.is_plain or not all(piece.is_sound() for piece in pieces):
            return None
        decoded = max(keys.passed, source.passed)
        return VideoMotion(key, decoded, keys.keys, coarse=True, pieces=pieces, notes=source.notes())


def _followed(
    video: Path, key: str, progress: Progress, effort: Effort, up: Up | None, early: Early | None
) -> VideoMotion | None:
    """The motion; None if it is not decoded exactly and the video is not plain. Raises SceneError."""
    exact = effort == "exact"
    with open_video(video, effort, up) as source:
        way = _Way(source, _DENSE, 1 if exact else source.often, progress, None if exact else early)
        for _ in way.follow(source, source.frames()):
            if not (exact or source.is_plain):
                return None
        if not (exact or source.is_plain):
            return None
        keys = [] if exact else source.keys
        return VideoMotion(key, source.passed, keys, pieces=way.finish(source), notes=source.notes())
