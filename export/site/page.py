"""What the page of a model shows besides the model: scene.json, which `static/page.d.ts` describes."""

import json
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

from panolog.export.frame import Frame
from panolog.scene.errors import InputError

MOST_CAMERAS = 20_000  # that a page has to choose from: 3 MB
PHOTOGRAPHS = "photos"  # the folder of photographs next to the page
_PHOTOGRAPH = re.compile(rf"{PHOTOGRAPHS}/([0-9]{{6}})\.jpg")
_FOV = 60  # degrees, vertical, of other viewers
_PLACES = 5  # decimals of positions and rotations


@dataclass(frozen=True)
class Pose:
    """Where a view is in the exported frame, and where it looks."""

    position: tuple[float, float, float]  # world units
    yaw: float  # degrees to the left of -z, seen from above
    pitch: float = 0.0  # degrees above the horizon

    @staticmethod
    def towards(position: NDArray[np.floating], ahead: NDArray[np.floating]) -> "Pose":
        """At a position (3,), looking along a direction (3,), both in the exported frame."""
        x, y, z = map(float, ahead)
        yaw, pitch = math.degrees(math.atan2(-x, -z)), math.degrees(math.atan2(y, math.hypot(x, z)))
        px, py, pz = (round(float(value), _PLACES) for value in position)
        return Pose((px, py, pz), round(yaw, 3), round(pitch, 3))

    @property
    def target(self) -> list[float]:
        """A point that it looks at, one unit ahead."""
        yaw, pitch = math.radians(self.yaw), math.radians(self.pitch)
        ahead = (-math.sin(yaw) * math.cos(pitch), math.sin(pitch), -math.cos(yaw) * math.cos(pitch))
        return [round(at + step, _PLACES) for at, step in zip(self.position, ahead, strict=True)]

    def as_json(self) -> dict[str, Any]:
        """The pose as scene.json has it."""
        return {"position": list(self.position), "yaw": self.yaw, "pitch": self.pitch}


@dataclass(frozen=True)
class PageCamera:
    """A panorama of the capture."""

    name: str
    pose: Pose
    # x y z w: turns the panorama's axes (x right, y down, z ahead) into the exported frame; None if unknown
    rotation: tuple[float, float, float, float] | None = None
    photograph: str | None = None  # URL of the equirectangular photograph, relative to the page

    def as_json(self) -> dict[str, Any]:
        """The camera as scene.json has it."""
        rotation = None if self.rotation is None else list(self.rotation)
        return {"name": self.name, **self.pose.as_json(), "rotation": rotation, "photograph": self.photograph}


@dataclass(frozen=True)
class Page:
    """What a page says and offers."""

    title: str
    total: int = 0  # Gaussians of the model; 0 if that is not known
    shown: int | None = None  # of them; None = all
    iteration: int | None = None  # of a model in training
    start: Pose | None = None  # None: at the first camera
    cameras: tuple[PageCamera, ...] = ()  # in the order in which one walks along them
    step: float | None = None  # world units: the sense of scale of the controls; None: as the model is large
    metres_per_unit: float | None = None  # None: distances are shown in units
    frame: Frame | None = None  # in which the page has the model; None: not known
    sky: bytes | None = (
        None  # JPEG: equirectangular, its middle towards -z; None: the model has its own or none
    )

    def as_json(self, model: str, sky: str | None) -> dict[str, Any]:
        """The content of scene.json. Args: model and sky, their URLs, relative to the page."""
        return {
            "title": self.title,
            "shown": self.total if self.shown is None else self.shown,
            "total": self.total,
            "iteration": self.iteration,
            "refresh": None,
            "model": model,
            "sky": sky,
            "start": self.start.as_json() if self.start else None,
            "cameras": [camera.as_json() for camera in self.cameras[:MOST_CAMERAS]],
            "step": self.step,
            "metres_per_unit": self.metres_per_unit,
            "frame": self.frame
            and {"rotation": self.frame.rotation.tolist(), "origin": self.frame.origin.tolist()},
        }

    def as_experience(self, sky: str | None) -> dict[str, Any]:
        """The content of settings.json, with which SuperSplat's viewer begins where this page does.

        Its format is `ExperienceSettings` of @playcanvas/supersplat-viewer. Args: as of `as_json`.
        """
        off: dict[str, Any] = {"enabled": False, "intensity": 0}
        grading = {"enabled": False, "brightness": 1, "contrast": 1, "saturation": 1, "tint": [1, 1, 1]}
        start = self.start or (self.cameras[0].pose if self.cameras else None)
        camera = start and {"position": list(start.position), "target": start.target, "fov": _FOV}
        return {
            "version": 2,
            "tonemapping": "none",
            "highPrecisionRendering": False,
            "background": {"color": [0, 0, 0], **({"skyboxUrl": sky} if sky else {})},
            "postEffectSettings": {
                "sharpness": {"enabled": False, "amount": 0},
                "bloom": off | {"blurLevel": 2},
                "grading": grading,
                "vignette": off | {"inner": 0.3, "outer": 0.75, "curvature": 1},
                "fringing": off,
            },
            "animTracks": [],
            "cameras": [{"initial": camera}] if camera else [],
            "annotations": [],
            "startMode": "default",
        }

    def with_photographs(self, urls: Sequence[str | None]) -> "Page":
        """This page with a URL for each camera; cameras without a rotation keep none."""
        cameras = zip(self.cameras, urls, strict=True)
        return replace(
            self,
            cameras=tuple(replace(camera, photograph=camera.rotation and url) for camera, url in cameras),
        )


def photograph_rotation(frame: Frame, rotation: NDArray[np.float64]) -> tuple[float, float, float, float]:
    """`PageCamera.rotation` of a panorama. Args: rotation (3, 3), from the world to the panorama's axes."""
    x, y, z, w = (
        scipy.spatial.transform.Rotation.from_matrix(frame.rotation @ rotation.T)
        .as_quat(canonical=True)
        .round(_PLACES + 1)
    )
    return float(x), float(y), float(z), float(w)


def photograph_url(number: int) -> str:
    """Where the photograph of a camera is, relative to the page."""
    return f"{PHOTOGRAPHS}/{number:06d}.jpg"


def photograph_number(path: str) -> int | None:
    """The inverse of `photograph_url`; None for any other path."""
    match = _PHOTOGRAPH.fullmatch(path)
    return None if match is None else int(match[1])


def described(data: bytes) -> tuple[bytes, list[str]]:
    """scene.json of a page that is served where its scene is: with photographs; and the cameras' names.

    Raises InputError if it is not one.
    """
    try:
        content: dict[str, Any] = json.loads(data)
        cameras = content["cameras"][:MOST_CAMERAS]
        for number, camera in enumerate(cameras):
            camera["photograph"] = photograph_url(number) if camera["rotation"] else None
        return json.dumps(content).encode(), [str(camera["name"]) for camera in cameras]
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise InputError("scene.json does not describe a page; write it again") from error
