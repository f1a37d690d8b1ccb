"""Extracts the frames of a 360° video for a reconstruction: sharp ones, an even baseline apart."""

import math
from collections.abc import Callable, Iterator
from dataclasses import replace
from datetime import timedelta
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from panolog.prepare.stitching.lenses import Up
from panolog.prepare.video.decode import Video, open_video, video_digest
from panolog.prepare.video.motion import SHARP_WIDTH, MotionTracker, VideoMotion, load_motion
from panolog.prepare.video.selection import choose_frames
from panolog.prepare.video.stamp import stamped
from panolog.prepare.video.streams import Effort, first_shown, open_container
from panolog.prepare.video.telemetry import Telemetry, read_telemetry
from panolog.prepare.world.exif import Attitude
from panolog.prepare.world.tracks import track_digest
from panolog.scene.errors import ConfigError, SceneError
from panolog.scene.files import SUFFIX, write_bytes
from panolog.scene.pictures.kinds import describe_picture
from panolog.scene.read import MASKS
from panolog.scene.write import Progress, no_progress

PARALLAX = 4.0  # degrees between neighbours: a metre in a street, a third of it in a room
_QUALITY = 95
_DENSE = 0.5  # degrees of parallax between two frames of a large video that are looked at, at most
_COARSE = 1.5 * PARALLAX  # degrees between frames from which decoding can begin, so that these suffice
_WIDEST = 45.0  # degrees of parallax from which no features match


def extract_frames(
    video: Path,
    folder: Path,
    *,
    parallax: float = PARALLAX,
    most: int | None = None,
    up: Up | None = None,
    progress: Progress = no_progress,
    note: Callable[[str], None] | None = None,
) -> list[Path]:
    """Writes the chosen frames of a 360° video to `folder`, as panoramas STEM_NUMBER.jpg in full size.

    They carry what the video knows of them as EXIF and XMP. What they do not cover is in `folder`/masks.
    Neighbours are about `parallax` apart, the median angle between the directions in which both see the same
    points, without the camera's rotation: where it stands or turns, there is one frame. Both ends are
    included. Where motion cannot be followed, as at a cut, a new piece begins.

    The motion is kept in STEM.motion.json: an interrupted call can be repeated, and another choice requires
    no new search. Frames of an earlier choice that are not in this one are removed.

    Args:
        video: any format that FFmpeg reads, of any frame rate.
        folder: made if missing.
        parallax: degrees, above 0 and up to 45.
        most: maximum number of frames, at least 2; if there were more, they are further apart.
        up: of a video that is to be stitched, where up is in its first circle; None: up.
        progress: called after each frame of the first pass and each that is written; counts both passes.
        note: called with a line about each thing that was left out.

    Returns:
        The files, in the order of the video.

    Raises InputError: the video is missing, damaged, not 2:1 or still two fisheye circles; it does not move;
    `folder` has frames of another video with this name; an option is out of its bounds; OSError: `folder`
    cannot be written.
    """
    if not 0 < parallax <= _WIDEST:
        raise ConfigError(f"parallax {parallax:g}: give an angle above 0 and up to {_WIDEST:g} degrees")
    if most is not None and most < 2:
        raise ConfigError(f"most {most}: give at least 2 frames; one panorama has no parallax")
    frames = _Frames(video, folder)
    found = _video_motion(video, frames.motion, progress, up, fine=parallax < PARALLAX)
    telemetry, left_out = read_telemetry(video)
    if note is not None:
        for line in (*found.notes, *left_out):
            note(line)
    numbers = choose_frames(found.pieces, parallax, most, found.keys)
    if len(numbers) < 2:
        raise SceneError(
            f"{video}: the camera moves by less than {parallax:g} degrees of parallax in it, so nothing can "
            "be reconstructed; walk with it, or give a smaller parallax"
        )
    folder.mkdir(parents=True, exist_ok=True)
    track = track_digest(video)
    frames.clear(set(found.chosen).difference(numbers if found.track == track else ()))
    if found.chosen != numbers or found.track != track:
        found.chosen, found.track = numbers, track
        found.save(frames.motion)
    _write(video, frames, found, telemetry, progress, up)
    return [frames.path(number) for number in numbers]


def frame_times(video: Path, folder: Path) -> list[float]:
    """Seconds since the first frame, of those that `extract_frames` has written; empty if it has not."""
    known = load_motion(_Frames(video, folder).motion)
    if known is None:
        return []
    with open_container(video) as container:
        times, first = known.times(), first_shown(container)
    return [times[number] - first for number in known.chosen]


class _Frames:
    """The files of one video's frames."""

    def __init__(self, video: Path, folder: Path) -> None:
        self._folder = folder
        self._stem = "".join(it if it.isalnum() or it in "-_" else "_" for it in video.stem)
        self.motion = folder / f"{self._stem}.motion.json"

    def path(self, number: int) -> Path:
        """The file of a frame."""
        return self._folder / f"{self._stem}_{number:06d}.jpg"

    def mask(self, number: int) -> Path:
        """The file of a frame's mask."""
        return self._folder / MASKS / f"{self.path(number).stem}.png"

    def save(self, number: int, source: Video, telemetry: Telemetry | None) -> bool:
        """Writes the present frame of `source` as frame `number`; whether it could be decoded."""
        picture = source.picture()
        if picture is None:
            return False
        if not source.layout.is_whole:
            self.mask(number).parent.mkdir(exist_ok=True)
            write_bytes(self.mask(number), _encoded(".png", source.layout.mask()))
        jpeg = _encoded(".jpg", picture, cv2.IMWRITE_JPEG_QUALITY, _QUALITY)
        write_bytes(self.path(number), _stamped(jpeg, source, telemetry))
        return True

    def clear(self, numbers: set[int]) -> None:
        """Removes frames with their masks, and partial files of a killed process."""
        for number in numbers:
            self.path(number).unlink(missing_ok=True)
            self.mask(number).unlink(missing_ok=True)
        for file in self._folder.iterdir():
            if file.name.startswith((f".{self._stem}_", f".{self.motion.name}")) and file.suffix == SUFFIX:
                file.unlink()


def _video_motion(video: Path, file: Path, progress: Progress, up: Up | None, *, fine: bool) -> VideoMotion:
    """The motion, from the file of an earlier call or from the video. Raises SceneError."""
    key = video_digest(video) + ("" if up is None else f"-{up}")
    known = load_motion(file)
    if known is not None and known.digest != key:
        raise SceneError(
            f"{file}: is about another video of the name {video.stem}, or of another --up; remove it and "
            "its frames, or give another folder"
        )
    if known is None or (fine and known.coarse):
        found = _search(video, key, progress, up, fine=fine)
        return found if known is None else replace(found, chosen=known.chosen, track=known.track)
    return known


def _search(video: Path, key: str, progress: Progress, up: Up | None, *, fine: bool) -> VideoMotion:
    """The first pass, again with care if the video turns out to be damaged. Raises SceneError."""
    found = None if fine else _coarsely_followed(video, key, progress, up)
    found = found or _followed(video, key, progress, "draft", up)
    found = found or _followed(video, key, progress, "exact", up)
    if found is None or not found.pieces:
        raise SceneError(f"{video}: is damaged, or shows nothing that can be tracked; no frame can be used")
    return found


def _coarsely_followed(video: Path, key: str, progress: Progress, up: Up | None) -> VideoMotion | None:
    """The motion by the frames from which decoding can begin, and by all others where these are far apart.

    None of a video that is small or not plain. Raises SceneError.
    """
    with open_video(video, "keys", up) as keys, open_video(video, "draft", up) as source:
        if source.often == 1:
            return None
        motion, last, coming = MotionTracker(source.width), -1.0, 0
        for number in keys.frames():
            if number < coming:
                continue
            grey = keys.grey(SHARP_WIDTH)
            if grey is None or not keys.is_plain:
                return None
            if not motion.add_near(number, keys.time, grey, _COARSE):
                if last >= 0 and not _follow(source, source.between(last, keys.time), motion, progress):
                    return None
                _add(motion, keys, number, grey)
            last, coming = keys.time, number + motion.frames_within(_DENSE, source.often)
            progress(keys.passed, 2 * max(keys.promised, keys.passed))
        if not _follow(source, source.between(last, math.inf), motion, progress):
            return None
        decoded = max(keys.passed, source.passed)
        return VideoMotion(key, decoded, keys.keys, coarse=True, pieces=motion.finish(), notes=source.notes())


def _followed(video: Path, key: str, progress: Progress, effort: Effort, up: Up | None) -> VideoMotion | None:
    """The motion; None of a draft of a video that is not plain. Raises SceneError."""
    draft = effort == "draft"
    with open_video(video, effort, up) as source:
        motion = MotionTracker(source.width)
        if not _follow(source, source.frames(), motion, progress, draft=draft):
            return None
        keys = source.keys if draft else []
        return VideoMotion(key, source.passed, keys, pieces=motion.finish(), notes=source.notes())


def _follow(
    source: Video, numbers: Iterator[int], motion: MotionTracker, progress: Progress, *, draft: bool = True
) -> bool:
    """Adds frames to the motion, of a draft fewer where the camera is slow.

    Returns whether a draft's video is plain. Raises SceneError.
    """
    coming = 0
    for number in numbers:
        if draft and not source.is_plain:
            return False
        if number >= coming:
            grey = source.grey(SHARP_WIDTH)
            coming = number + (motion.frames_within(_DENSE, source.often) if draft else 1)
            if grey is not None:
                _add(motion, source, number, grey)
            progress(source.passed, 2 * max(source.promised, source.passed))
    return source.is_plain or not draft


def _add(motion: MotionTracker, source: Video, number: int, grey: NDArray[np.uint8]) -> None:
    """Raises SceneError if the first frame is no panorama."""
    if not motion.pieces and (what := describe_picture(grey)) is not None:
        raise SceneError(f"{source.path}: its frames are {what}")
    motion.add(number, source.time, grey)


def _write(
    video: Path,
    frames: _Frames,
    found: VideoMotion,
    telemetry: Telemetry | None,
    progress: Progress,
    up: Up | None,
) -> None:
    """The second pass, for the missing frames: to each of them, or in order where that does not find one."""
    times, before = found.times(), found.decoded
    missing = [number for number in found.chosen if not frames.path(number).is_file()]
    if missing and found.keys:
        last = missing[-1]
        with open_video(video, "chosen", up) as source:
            there = source.frames_at([times[number] for number in missing], found.keys)
            for number, _ in zip(tuple(missing), there, strict=False):
                if not frames.save(number, source, telemetry):
                    break
                missing.remove(number)
                progress(before + number + 1, before + last + 1)
    if not missing:
        return
    last = missing[-1]
    wanted = {times[number] if found.keys else number: number for number in missing}
    with open_video(video, up=up) as source:
        for number in source.frames():
            at = wanted.pop(source.time if found.keys else number, None)
            if at is not None and not frames.save(at, source, telemetry):
                break
            progress(before + min(number, last) + 1, before + last + 1)
            if not wanted:
                return
    raise SceneError(
        f"{video}: frame {min(wanted.values())} cannot be read any more; the video has changed, or its disk "
        "fails"
    )


def _encoded(suffix: str, picture: NDArray[np.uint8], *options: int) -> bytes:
    """The picture as a file."""
    return bytes(cv2.imencode(suffix, picture, list(options))[1])


def _stamped(jpeg: bytes, source: Video, telemetry: Telemetry | None) -> bytes:
    """The JPEG of the present frame with what the video knows of it."""
    fix = None if telemetry is None else telemetry.fix(source.time)
    attitude = None if telemetry is None else telemetry.attitude(source.time)
    spherical = source.spherical
    if attitude is None and spherical is not None and (spherical.pitch or spherical.roll):
        attitude = Attitude(None, spherical.pitch, spherical.roll)
    taken = None if source.started is None else source.started + timedelta(seconds=source.time - source.first)
    exposure = None if telemetry is None else telemetry.exposure(source.time)
    return stamped(jpeg, fix=fix, attitude=attitude, taken=taken, exposure=exposure)
