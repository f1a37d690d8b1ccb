"""The picture of a 3D page in a browser, and our own render of the same view."""

import math

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from playwright.sync_api import Page

from panolog.orchestrator.views.viewpoints import Viewpoints
from panolog.renderer.camera import Camera, Lens, perspective
from panolog.renderer.render import render, to_bytes
from panolog.scene.gaussians import Gaussians, logit

_FOV = 75.0  # degrees, vertical: of viser's camera
# Records which sorted indices arrive; before all scripts of a page.
_OBSERVE = """
    const Native = Worker;
    window.sorted = [];
    window.Worker = class extends Native {
        constructor(...given) {
            super(...given);
            this.addEventListener("message", ({data}) => { window.sorted = [...data.sortedIndices]; });
        }
    };
"""


def observe_sorting(page: Page) -> None:
    """Makes a page keep the latest result of its worker as `sorted`; call it before the page is opened."""
    page.add_init_script(_OBSERVE)


def shown(page: Page) -> NDArray[np.uint8]:
    """(H, W, 3) BGR: what viser draws once sorted and at rest, without the panel and notices over it."""
    page.wait_for_selector("#panolog-home:enabled")
    page.evaluate("__viserTestpoints.devSettings.set({fixedDpr: 1})")  # else it follows the speed
    page.add_style_tag(content="#panolog, .mantine-Notifications-root { display: none !important; }")
    page.wait_for_function("sorted.length > 0")
    pictures = [_picture(page)]
    while len(pictures) < 3 or not all(np.array_equal(picture, pictures[-1]) for picture in pictures[-3:]):
        pictures.append(_picture(page))
    return pictures[-1]


def _picture(page: Page) -> NDArray[np.uint8]:
    png = np.frombuffer(page.screenshot(), np.uint8)
    return np.asarray(cv2.imdecode(png, cv2.IMREAD_COLOR), np.uint8)


def rendered(
    model: Gaussians, viewpoints: Viewpoints, size: tuple[int, int], background: NDArray[np.uint8]
) -> NDArray[np.uint8]:
    """(H, W, 3) BGR of a model from where the viewpoints start, over a background (3,); size is (W, H)."""
    width, height = size
    view, down = viewpoints.start, -viewpoints.up
    fov = 2 * math.degrees(math.atan(math.tan(math.radians(_FOV) / 2) * width / height))
    lens = Lens(width, height, fov)
    rotation = np.stack([np.cross(down, view.ahead), down, view.ahead])
    W = lens.panorama_width
    drawn = render(model, Camera.of(rotation, -rotation @ view.position, W, W // 2), sh_degree=0)
    behind = (1 - drawn.alpha)[..., None] * torch.from_numpy(background[::-1] / np.float32(255))
    return np.ascontiguousarray(perspective(to_bytes(drawn.color + behind), lens)[..., ::-1])


def layers(viewpoints: Viewpoints, count: int = 60) -> Gaussians:
    """Opaque balls in front of where the viewpoints start, nearest first: not the order to draw."""
    random = torch.Generator().manual_seed(1)
    depth = torch.linspace(2, 12, count)[:, None]
    across = (torch.rand(count, 2, generator=random) - 0.5) * depth * 0.9
    down, ahead = -viewpoints.up, viewpoints.start.ahead
    axes = torch.from_numpy(np.stack([np.cross(down, ahead), down, ahead])).float()
    return Gaussians(
        means=torch.cat([across, depth], 1) @ axes + torch.from_numpy(viewpoints.start.position).float(),
        quats=torch.eye(4)[:1].repeat(count, 1),
        scales=(depth * 0.1).log().repeat(1, 3),
        opacities=torch.full((count,), logit(0.99)),
        sh0=(torch.rand(count, 1, 3, generator=random) - 0.5) * 3.5,
        shN=torch.zeros(count, 15, 3),
        sky=0,
    )


def psnr(first: NDArray[np.uint8], second: NDArray[np.uint8]) -> float:
    """Peak signal-to-noise ratio in dB of two pictures of the same shape."""
    return float(cv2.PSNR(first, second))
