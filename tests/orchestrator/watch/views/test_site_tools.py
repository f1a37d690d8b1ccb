"""What is made of the view in the 3D page: pictures, crops for `export`, and paths for `render`."""

from pathlib import Path

import numpy as np
import pytest
import torch
from playwright.sync_api import Browser, Page

from panolog.export.splats import Selection, Splats
from panolog.renderer.poses import read_poses
from tests.orchestrator.watch.dashboard.browser import opened
from tests.orchestrator.watch.views.sites import SIZE, page_of_layers, psnr, rendered, shown
from tests.visual.compare import expand

pytestmark = pytest.mark.system


def press(page: Page, name: str) -> None:
    """Presses a button that may be behind others."""
    page.evaluate(f"document.getElementById({name!r}).click()")


def test_views_are_saved_cropped_and_rendered_from(browser: Browser, tmp_path: Path) -> None:
    file, model, viewpoints = page_of_layers(tmp_path)
    with opened(browser, file.as_uri(), width=SIZE[0], height=SIZE[1]) as page:
        whole = shown(page)
        with page.expect_download() as picture:
            press(page, "picture")
        saved = expand(picture.value.path().read_bytes())
        assert psnr(saved, whole) > 35
        press(page, "key")
        page.evaluate("panolog.flight.set({ position: [1, 2, 3], yaw: 20, pitch: 10 })")
        press(page, "key")
        with page.expect_download() as path:
            press(page, "save-path")
        path.value.save_as(tmp_path / "path.json")
        press(page, "home")
        page.evaluate("document.getElementById('edges').style.display = 'none'")
        slider = "document.getElementById('lower-x')"
        page.evaluate(f"{slider}.value = 500; {slider}.dispatchEvent(new Event('input'))")
        option = page.evaluate("document.getElementById('option').textContent")
        cropped = shown(page)
        press(page, "whole")
        assert psnr(shown(page), whole) > 35
    a, b, c, x, y, z = map(float, option.removeprefix("--crop=").split(","))
    kept = Selection(crop=((a, b, c), (x, y, z))).keeps(Splats.of(model), np.ones(len(model), bool))
    assert 0 < kept.sum() < len(model)
    inside = torch.from_numpy(kept)
    quality = psnr(cropped, rendered(model.select(inside), viewpoints, SIZE, background=cropped[0, 0]))
    assert quality >= 25, f"{quality:.1f} dB"
    first, *_, last = poses = read_poses(tmp_path / "path.json")
    assert len(poses) == 300
    start, down = viewpoints.start, -viewpoints.up
    axes = np.stack([np.cross(down, start.ahead), down, start.ahead])
    assert np.allclose(first.rotation, axes, atol=1e-3)
    assert np.allclose(-first.rotation.T @ first.translation, start.position, atol=1e-3)
    assert np.arccos(last.rotation[2] @ viewpoints.up) == pytest.approx(np.deg2rad(80), abs=1e-3)
