"""Two chapters of a video, and photographs of another size, of one street whose shots are known."""

from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

import cv2
import numpy as np

from panolog.prepare.video.stamp import stamped
from tests.prepare.video.videos import Shot, render, walk, write_video

VIDEO, PHOTOGRAPH = 512, 640  # pixels of a panorama
STEP = 0.14  # metres between two frames


@dataclass(frozen=True)
class Street:
    """What was taken of the street."""

    first: Path  # chapter
    second: Path
    photographs: Path
    frames: list[Shot]  # of both chapters
    stills: list[Shot]  # in the order of their times, which is not that of their names

    @property
    def all(self) -> list[Path]:
        """In no order."""
        return [self.second, self.photographs, self.first]

    def along(self, name: str) -> float:
        """Metres along the street where a panorama of the scene was taken."""
        label, _, file = name.partition("/")
        if label == "stills":
            return self.stills[9 - int(Path(file).stem)].along
        number = int(Path(file).stem.rpartition("_")[2])
        return self.frames[number + (len(self.frames) // 2 if label == "GX020001" else 0)].along


def make_street(folder: Path) -> Street:
    """Writes it. The chapters are written in the wrong order, one photograph has a mask, and one a copy."""
    frames, stills = walk([STEP] * 24), walk([0.8] * 4, start=0.1)
    for name, part in (("GX020001", frames[12:]), ("GX010001", frames[:12])):
        write_video(folder / f"{name}.MP4", [render(shot, VIDEO) for shot in part], fourcc="mp4v")
    (folder / "stills" / "images").mkdir(parents=True)
    (folder / "stills" / "masks").mkdir()
    for number, shot in enumerate(stills):
        jpeg = bytes(cv2.imencode(".jpg", render(shot, PHOTOGRAPH), [cv2.IMWRITE_JPEG_QUALITY, 95])[1])
        taken = datetime(2020, 5, 1, 10, number)
        (folder / "stills" / "images" / f"{9 - number}.jpg").write_bytes(stamped(jpeg, taken=taken))
    cv2.imwrite(str(folder / "stills" / "masks" / "8.png"), np.full((32, 64), 255, np.uint8))
    (folder / "stills" / "images" / "copy.jpg").write_bytes(
        (folder / "stills" / "images" / "9.jpg").read_bytes()
    )
    return Street(folder / "GX010001.MP4", folder / "GX020001.MP4", folder / "stills", frames, stills)
