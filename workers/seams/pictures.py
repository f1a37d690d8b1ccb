"""Pictures of a face between two blocks: perspective views of the photograph and of what the models show."""

from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray

from panolog.renderer.camera import Lens, facing, perspective
from panolog.renderer.render import encode_jpeg
from panolog.workers.seams.strips import Look, Strip, directions

_LENS = Lens(480, 360, 75.0)
_YAWS, _PITCHES = range(0, 360, 15), (-5, -25)  # degrees: the directions in which a picture may look
_CONE = 30.0  # degrees around the middle of a picture in which it should show the face
_SMOOTH = 4.0  # pixels over which a marked face is straightened: its points are as uneven as depths
_BOTH = 32  # of 255: both sides of the face are there
_LINE = ((5, (255, 255, 255, 255)), (3, (208, 0, 112, 255)))  # widths in pixels and BGRA of a marked face

Image = NDArray[np.uint8]


@dataclass(eq=False)
class Picture:
    """What a camera shows of a face."""

    look: Look
    truth: Image  # (H, W, 3), as all others: panoramas
    merged: Image
    strip: Strip
    direction: NDArray[np.float64]  # (3, 3) from the lens to the panorama
    area: float  # of the strip around the middle of the picture
    blocks: list[Image] = field(default_factory=list)  # what the blocks below and above the face show

    @staticmethod
    def of(look: Look, strip: Strip, truth: Image, merged: Image) -> "Picture":
        """From the direction in which a camera sees most of a strip, the first of equal ones."""
        rays = directions(strip.pixels, merged.shape[1])
        turns = [facing(yaw, pitch) for pitch in _PITCHES for yaw in _YAWS]
        ahead = [np.einsum("pi,i->p", rays, turn[:, 2]) > np.cos(np.radians(_CONE)) for turn in turns]
        areas = [float(strip.area[seen].sum()) for seen in ahead]
        best = int(np.argmax(areas))
        return Picture(look, truth, merged, strip, turns[best], areas[best])

    def files(self) -> dict[str, bytes]:
        """The files by name: four pictures, and the face as a line on a transparent ground."""
        panoramas = {"truth": self.truth, "merged": self.merged}
        panoramas |= dict(zip(("below", "above"), self.blocks, strict=True))
        files = {
            f"{name}.jpg": encode_jpeg(perspective(panorama, _LENS, self.direction), _LENS.width)
            for name, panorama in panoramas.items()
        }
        return files | {"face.png": self._line()}

    def _line(self) -> bytes:
        """Where the strip changes sides."""
        height, width = self.merged.shape[:2]
        sides = np.zeros((height * width, 3), np.uint8)
        sides[self.strip.pixels[self.strip.offsets < 0], 0] = 255
        sides[self.strip.pixels[self.strip.offsets >= 0], 1] = 255
        seen = perspective(sides.reshape(height, width, 3), _LENS, self.direction)
        smooth = cv2.GaussianBlur(seen.astype(np.float32), (0, 0), _SMOOTH)
        below = (smooth[..., 0] > smooth[..., 1]).astype(np.uint8)
        rim = cv2.dilate(below, np.ones((3, 3), np.uint8)) - below
        line = rim * (smooth[..., :2].min(axis=2) > _BOTH)
        picture = np.zeros((*line.shape, 4), np.uint8)
        for thickness, color in _LINE:
            picture[cv2.dilate(line, np.ones((thickness, thickness), np.uint8)) > 0] = color
        return bytes(cv2.imencode(".png", picture)[1])
