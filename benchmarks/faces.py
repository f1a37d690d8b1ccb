"""PSNR on cube faces: what trainers that know only pinhole cameras report, measured on a finished run.

    python -m benchmarks.faces RUN [--size 256]

Each held-out panorama is rendered; render and truth are cut into six faces of 90°; the mean is over all.
"""

import argparse
import json
from pathlib import Path

import numpy as np

from panolog.orchestrator.run.folder import RunFolder
from panolog.orchestrator.run.info import read_info
from panolog.renderer.camera import Lens, facing, perspective
from panolog.renderer.render import render_panorama
from panolog.scene.images import load_view
from panolog.scene.ply import read_ply
from panolog.scene.read import read_scene
from panolog.workers.metrics import measure
from panolog.workers.training.initialise import near_distance

FACES = {  # yaw and pitch in degrees
    "front": (0, 0),
    "right": (90, 0),
    "back": (180, 0),
    "left": (-90, 0),
    "up": (0, 90),
    "down": (0, -90),
}


def face_psnr(folder: RunFolder, size: int) -> dict[str, float]:
    """Mean PSNR in dB over the held-out panoramas, by face and over all faces of `size` pixels."""
    info = read_info(folder)
    scene, config = read_scene(Path(info.scene.path)), info.config
    model = read_ply(folder.point_cloud)
    near = near_distance(scene, config)
    width = config.width or scene.width
    lens = Lens(size, size, 90.0)
    found: dict[str, list[float]] = {name: [] for name in FACES}
    for row in scene.test:
        panorama = scene.panoramas[row]
        truth = load_view(panorama, row, width).image.numpy()
        render = render_panorama(model, panorama.rotation, panorama.translation, width, near)
        for name, direction in FACES.items():
            turn = facing(*direction)
            psnr = measure(perspective(render, lens, turn), perspective(truth, lens, turn))["psnr"]
            found[name].append(psnr or 0.0)
    means = {name: float(np.mean(values)) for name, values in found.items()}
    return means | {"mean": float(np.mean(list(means.values())))}


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("run", type=Path)
    parser.add_argument("--size", type=int, default=256, help="pixels of a face (256)")
    options = parser.parse_args()
    print(json.dumps(face_psnr(RunFolder(options.run), options.size), indent=2))


if __name__ == "__main__":
    main()
