"""Renders a PLY along a smooth path through the cameras of a scene.

python examples/render_path.py SCENE MODEL.ply FOLDER --frames 60 --width 1024
"""

import argparse
from collections.abc import Sequence
from pathlib import Path

import cv2
import torch

import panolog


def main(arguments: Sequence[str] | None = None) -> None:
    """Writes FOLDER/frame_00000.png and so on."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("scene", metavar="SCENE")
    parser.add_argument("model", metavar="MODEL.ply")
    parser.add_argument("folder", metavar="FOLDER", type=Path)
    parser.add_argument("--frames", type=int, default=60)
    parser.add_argument("--width", type=int, default=1024, help="pixels, even")
    options = parser.parse_args(arguments)

    scene = panolog.read_scene(options.scene)
    model = panolog.read_ply(options.model).to("cuda" if torch.cuda.is_available() else "cpu")
    options.folder.mkdir(parents=True, exist_ok=True)
    for pose in panolog.smooth_path(scene.panoramas, options.frames):
        camera = panolog.Camera.of(pose.rotation, pose.translation, options.width, options.width // 2)
        with torch.no_grad():
            color = panolog.render(model, camera.to(model.means.device)).color  # (H, W, 3), RGB, 0 to 1
        image = (color.clamp(0, 1) * 255).round().to(torch.uint8).cpu().numpy()
        cv2.imwrite(str(options.folder / f"{pose.name}.png"), cv2.cvtColor(image, cv2.COLOR_RGB2BGR))


if __name__ == "__main__":
    main()
