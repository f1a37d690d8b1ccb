"""People who walk through the street leave the model when a network masks them; `-s` prints the figures."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

import panolog
from panolog.prepare.networks.masks import mask_scene
from panolog.renderer.render import render_panorama
from panolog.scene.image_files import decode
from panolog.scene.model import Scene
from panolog.scene.read import read_scene
from panolog.scene.write import no_progress
from panolog.workers.events import Trained
from tests.data import shared
from tests.prepare.networks.people import finder, paint_people

pytestmark = [pytest.mark.system, pytest.mark.nightly, pytest.mark.timeout(3600)]

WIDTH, ITERATIONS = 256, 300
CLEAN_WITHIN, MASKS_WITHIN, ABOVE = 1.0, 0.3, 0.6  # dB of PSNR and of WS-PSNR
COLORED = (
    20  # of 255, by which green is less than red and blue in people's clothes, and nowhere in the street
)


def linked(folder: Path, images: Path, street: Path, masks: Path | None = None) -> Scene:
    """A scene of the street's poses and these panoramas."""
    folder.mkdir()
    for name, target in (("images", images), ("sparse", street / "sparse"), ("masks", masks)):
        if target is not None:
            (folder / name).symlink_to(target)
    return read_scene(folder)


def distances(street: Path) -> dict[str, NDArray[np.float64]]:
    """(h, 2h) metres to what each panorama shows, by its stem."""
    found = {}
    for stem, line in json.loads((street / "depth_truth.json").read_text()).items():
        stored = decode(street / "depths" / f"{stem}.png", cv2.IMREAD_UNCHANGED) / 65535
        inverse = np.maximum(stored * line["scale"] + line["offset"], 1e-3)
        found[stem] = np.where(stored > 0, 1 / inverse, 1e3)
    return found


def trained(scene: Scene, clean: Scene) -> tuple[float, float, float]:
    """PSNR and WS-PSNR of held-out panoramas, which are without people, and the share of people's colour."""
    config = panolog.RunConfig(width=WIDTH, iterations=ITERATIONS)
    *_, last = panolog.train(scene, config)
    assert isinstance(last, Trained)
    mean = panolog.evaluate(last.gaussians, clean, width=WIDTH)["mean"]
    colored = []
    for row in clean.test:
        it = clean.panoramas[row]
        shown = render_panorama(last.gaussians, it.rotation, it.translation, WIDTH, 0.1).astype(int)
        red, green, blue = np.moveaxis(shown, -1, 0)
        colored.append((np.minimum(red, blue) - green > COLORED).mean())
    return mean["psnr"], mean["ws_psnr"], float(np.mean(colored))


def test_masked_people_leave_no_trace_in_the_model(tmp_path: Path) -> None:
    """What masks cost is what they hide of the street: the same of panoramas without people."""
    street, crowd = shared("street"), tmp_path / "crowd"
    clean = linked(tmp_path / "clean", street / "images", street)
    where = paint_people(clean, crowd, distances(street))
    mask_scene(
        crowd,
        nadir=None,
        static=False,
        model=finder(tmp_path),
        batch=4,
        device="cpu",
        progress=no_progress,
    )
    masks, people = crowd / "masks", crowd / "images"
    ignored = {row: decode(masks / f"{clean.panoramas[row].stem}.png", 0) == 0 for row in where}
    body = np.concatenate([ignored[row][share > 0.5] for row, share in where.items()])
    assert body.mean() > 0.999
    assert np.mean([it.mean() for it in ignored.values()]) < 0.2
    assert any(share[:, 0].any() and share[:, -1].any() for share in where.values())  # across the seam
    assert all((share[-len(share) // 5 :] > 0).any() for share in where.values())  # the operator, below
    scenes = {
        "no people": clean,
        "no people, but the same masks": linked(tmp_path / "hidden", street / "images", street, masks),
        "people, masks": linked(tmp_path / "masked", people, street, masks),
        "people": linked(tmp_path / "people", people, street),
    }
    found = {name: trained(scene, clean) for name, scene in scenes.items()}
    covered = np.mean([share.mean() for share in where.values()])
    print(
        f"\n{ITERATIONS} iterations at {WIDTH} pixels; people cover {covered:.1%} of each training panorama"
    )
    for name, (psnr, ws_psnr, colored) in found.items():
        print(f"{name}: PSNR {psnr:.2f} dB, WS-PSNR {ws_psnr:.2f} dB, {colored:.2%} in their colour")
    empty, hidden, masked, unmasked = (np.array(it[:2]) for it in found.values())
    assert (masked > empty - CLEAN_WITHIN).all()
    assert (masked > hidden - MASKS_WITHIN).all()
    assert (masked > unmasked + ABOVE).all()
    assert found["people, masks"][2] < 1e-4
    assert found["people"][2] > 1e-2
