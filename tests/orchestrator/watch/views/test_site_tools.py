"""What is made of the view in the 3D page: pictures, crops for `export`, and paths for `render`."""

from pathlib import Path

import numpy as np
import pytest
import torch
from playwright.sync_api import Browser, Page

from panolog.export.splats import Selection, Splats, Surroundings
from panolog.renderer.poses import read_poses
from tests.orchestrator.watch.dashboard.browser import opened
from tests.orchestrator.watch.views.sites import SIZE, page_of_layers, psnr, rendered, shown
from tests.visual.compare import expand

pytestmark = pytest.mark.system


def move(page: Page, name: str, value: int) -> None:
    """Moves a slider that may be behind others."""
    page.evaluate(
        "([name, value]) => { const slider = document.getElementById(name); slider.value = value;"
        " slider.dispatchEvent(new Event('input')); }",
        [name, value],
    )


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
        move(page, "lower-x", 500)
        option = page.evaluate("document.getElementById('option').textContent")
        cropped = shown(page)
        press(page, "whole")
        assert psnr(shown(page), whole) > 35
    a, b, c, x, y, z = map(float, option.removeprefix("--crop=").split(","))
    kept = Selection(crop=((a, b, c), (x, y, z))).keeps(Splats.of(model), np.ones(len(model), bool))
    assert 0 < kept.sum() < len(model)
    assert np.array_equal(kept, model.means[:, 0].numpy() >= np.float32(a))  # no other side was moved
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


def test_floaters_are_hidden_as_export_leaves_them_out(browser: Browser, tmp_path: Path) -> None:
    order = torch.randperm(60, generator=torch.Generator().manual_seed(2))
    file, model, viewpoints = page_of_layers(tmp_path, torch.linspace(-2, 4, 60)[order])
    cameras = viewpoints.positions
    with opened(browser, file.as_uri(), width=SIZE[0], height=SIZE[1]) as page:
        whole = shown(page)
        for faint, large, far in ((500, 1000, 1000), (0, 500, 1000), (0, 1000, 250), (500, 500, 300)):
            move(page, "fainter", faint)
            move(page, "larger", large)
            move(page, "farther", far)
            text = page.evaluate("document.getElementById('option').textContent")
            option = {name: float(value) for name, value in (word.split("=") for word in text.split())}
            given = {"--min-opacity": faint > 0, "--max-size": large < 1000, "--max-distance": far < 1000}
            assert option.keys() == {name for name, limits in given.items() if limits}
            selection = Selection(
                min_opacity=option.get("--min-opacity", 0.0),
                max_size=option.get("--max-size"),
                near=(Surroundings(cameras, option.get("--max-distance", np.inf)),),
            )
            kept = selection.keeps(Splats.of(model), np.ones(len(model), bool))
            assert 5 < kept.sum() < len(model) - 5
            cleaned = shown(page)
            inside = model.select(torch.from_numpy(kept))
            quality, other = (
                psnr(cleaned, rendered(it, viewpoints, SIZE, background=cleaned[0, 0]))
                for it in (inside, model)
            )
            assert quality >= max(25, other + 3), f"{text}: {quality:.1f} dB, with all {other:.1f} dB"
        press(page, "whole")
        assert psnr(shown(page), whole) > 35
        assert page.evaluate("document.getElementById('kept').hidden")
