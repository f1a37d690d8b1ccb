"""Extracts the frames of a 360° video for a reconstruction: sharp ones, an even baseline apart."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from datetime import timedelta
from functools import cache, partial
from pathlib import Path

import av
import cv2
import numpy as np
from numpy.typing import NDArray

from panolog.prepare.stitching.lenses import Up
from panolog.prepare.video.decode import Video, open_video, video_digest
from panolog.prepare.video.motion import VideoMotion, load_motion
from panolog.prepare.video.selection import PARALLAX, Early, choose_frames, search
from panolog.prepare.video.stamp import stamped
from panolog.prepare.video.streams import first_shown, open_container
from panolog.prepare.video.telemetry import Telemetry, read_telemetry
from panolog.prepare.world.exif import Attitude
from panolog.prepare.world.tracks import track_digest
from panolog.scene.errors import ConfigError, SceneError
from panolog.scene.files import SUFFIX, publish, write_bytes
from panolog.scene.read import MASKS
from panolog.scene.write import Progress, no_progress

_QUALITY = 95
_WIDEST = 45.0  # degrees of parallax from which no features match

Sensors = Callable[[], tuple[Telemetry | None, list[str]]]  # `read_telemetry` of a video


@dataclass(frozen=True)
class FrameChoice:
    """Which frames of a video become panoramas, and how what shows two fisheye circles is stitched."""

    parallax: float = PARALLAX  # degrees between two of them
    frames: int | None = None  # of each video at most
    up: Up | None = None  # where up is in the first circle


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
    _check(parallax, most)
    frames, sensors = _Frames(video, folder), cache(partial(read_telemetry, video))
    early = Early(parallax, partial(frames.save_early, sensors)) if most is None else None
    frames.tidy()
    found = _video_motion(video, frames.motion, progress, up, early, fine=parallax < PARALLAX)
    telemetry, left_out = sensors()
    if note is not None:
        for line in (*found.notes, *left_out):
            note(line)
    numbers = choose_frames(found.pieces, parallax, most)
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
    frames.publish(() if early is None else early.written.intersection(numbers))
    _write(video, frames, found, telemetry, progress, up)
    return [frames.path(number) for number in numbers]


def _check(parallax: float, most: int | None) -> None:
    """Raises ConfigError if an option is out of its bounds."""
    if not 0 < parallax <= _WIDEST:
        raise ConfigError(f"parallax {parallax:g}: give an angle above 0 and up to {_WIDEST:g} degrees")
    if most is not None and most < 2:
        raise ConfigError(f"most {most}: give at least 2 frames; one panorama has no parallax")


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
        jpeg = _jpeg(source, source.frame, source.time, telemetry)
        if jpeg is None:
            return False
        if not source.layout.is_whole:
            self.mask(number).parent.mkdir(exist_ok=True)
            write_bytes(self.mask(number), _encoded(".png", source.layout.mask()))
        write_bytes(self.path(number), jpeg)
        return True

    def clear(self, numbers: set[int]) -> None:
        """Removes frames with their masks."""
        for number in numbers:
            self.path(number).unlink(missing_ok=True)
            self.mask(number).unlink(missing_ok=True)

    def save_early(
        self, sensors: Sensors, number: int, source: Video, frame: av.VideoFrame, time: float
    ) -> bool:
        """Writes a frame of `source` that may be chosen; whether it is one that covers all, and written."""
        jpeg = _jpeg(source, frame, time, sensors()[0]) if source.layout.is_whole else None
        if jpeg is not None:
            self._folder.mkdir(parents=True, exist_ok=True)
            self._early(number).write_bytes(jpeg)  # `publish` brings it to the disk
        return jpeg is not None

    def publish(self, numbers: Iterable[int]) -> None:
        """Gives frames that `save_early` has written their names, and removes all others of these."""
        for number in numbers:
            publish(self._early(number), self.path(number))
        self.tidy()

    def tidy(self) -> None:
        """Removes frames of `save_early`, and partial files, also those of a killed process."""
        names = (f"{self._stem}_", self.motion.name)
        for file in self._folder.glob(f".*{SUFFIX}"):
            if file.name.lstrip(".").startswith(names):
                file.unlink()

    def _early(self, number: int) -> Path:
        return self._folder / f".{self.path(number).name}{SUFFIX}"


def _video_motion(
    video: Path, file: Path, progress: Progress, up: Up | None, early: Early | None, *, fine: bool
) -> VideoMotion:
    """The motion, from the file of an earlier call or from the video. Raises SceneError."""
    key = video_digest(video) + ("" if up is None else f"-{up}")
    known = load_motion(file)
    if known is not None and known.digest != key:
        raise SceneError(
            f"{file}: is about another video of the name {video.stem}, or of another --up; remove it and "
            "its frames, or give another folder"
        )
    if known is None or (fine and known.coarse):
        found = search(video, key, progress, up, early, fine=fine)
        return found if known is None else replace(found, chosen=known.chosen, track=known.track)
    return known


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
        with open_video(video, "fast", up) as source:
            there = source.frames_at([times[number] for number in missing], found.keys)
            for number, _ in zip(tuple(missing), there, strict=False):
                if not frames.save(number, source, telemetry):
                    break
                missing.remove(number)
                progress(before + number + 1, before + last + 1)
    if not missing:
        last = found.chosen[-1]
        progress(before + last + 1, before + last + 1)
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


def _jpeg(source: Video, frame: av.VideoFrame, time: float, telemetry: Telemetry | None) -> bytes | None:
    """A frame of `source` as JPEG, with what the video knows of its time; None if it cannot be converted."""
    picture = source.picture(frame)
    if picture is None:
        return None
    jpeg = _encoded(".jpg", picture, cv2.IMWRITE_JPEG_QUALITY, _QUALITY)
    fix = None if telemetry is None else telemetry.fix(time)
    attitude = None if telemetry is None else telemetry.attitude(time)
    spherical = source.spherical
    if attitude is None and spherical is not None and (spherical.pitch or spherical.roll):
        attitude = Attitude(None, spherical.pitch, spherical.roll)
    taken = None if source.started is None else source.started + timedelta(seconds=time - source.first)
    exposure = None if telemetry is None else telemetry.exposure(time)
    return stamped(jpeg, fix=fix, attitude=attitude, taken=taken, exposure=exposure)


def _encoded(suffix: str, picture: NDArray[np.uint8], *options: int) -> bytes:
    """The picture as a file."""
    return bytes(cv2.imencode(suffix, picture, list(options))[1])
