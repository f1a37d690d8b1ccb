"""What is known of a video's motion, kept as JSON beside its frames: the search for it is what takes long."""

import json
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from panolog.prepare.video.decode import MAX_FRAMES
from panolog.prepare.video.motion import Piece
from panolog.scene.files import write_bytes

_VERSION = 1  # of how motion is found; what another one has found is of no use
_LARGEST = 64 * MAX_FRAMES  # bytes


@dataclass
class VideoMotion:
    """The motion in a video, and which of its frames have been written."""

    digest: str  # of the video
    decoded: int = 0  # frames
    pieces: list[Piece] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    chosen: list[int] = field(default_factory=list)  # numbers of frames that are, or will be, files

    def save(self, path: Path) -> None:
        """Writes it atomically. Raises OSError."""
        write_bytes(path, json.dumps({"version": _VERSION, **asdict(self)}).encode())


def load(path: Path) -> VideoMotion | None:
    """What `Found.save` wrote; None if it is missing, damaged or of another version. Raises OSError."""
    if not path.is_file() or path.stat().st_size > _LARGEST:
        return None
    try:
        read = json.loads(path.read_bytes())
        if read["version"] != _VERSION:
            return None
        return VideoMotion(
            str(read["digest"]),
            _number(read["decoded"]),
            [_piece(it) for it in read["pieces"]],
            [str(it) for it in read["notes"]],
            [_number(it) for it in read["chosen"]],
        )
    except (ValueError, KeyError, TypeError, RecursionError):
        return None


def _piece(read: Any) -> Piece:
    """A piece from JSON. Raises ValueError, KeyError or TypeError."""
    frames = [_number(it) for it in read["frames"]]
    if not frames or frames != sorted(set(frames)):
        raise ValueError
    return Piece(frames, _values(read["positions"], len(frames)), _values(read["sharpness"], len(frames)))


def _values(read: Any, count: int) -> list[float]:
    """`count` finite numbers from JSON. Raises ValueError or TypeError."""
    values = np.array(read, np.float64)
    if values.shape != (count,) or not np.isfinite(values).all():
        raise ValueError
    return [float(value) for value in values]


def _number(read: Any) -> int:
    """A frame's number from JSON. Raises ValueError."""
    if not isinstance(read, int) or not 0 <= read <= MAX_FRAMES:
        raise ValueError
    return read
