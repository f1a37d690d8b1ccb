"""Pairs of splats and tiles for each Gaussian, which decide the memory of sorting on a GPU.

    python -m benchmarks.rasterizer.pairs [MODEL.ply SCENE]... [--width 1024,2048,4096] [--random 1000000]

For models of scenes that `panolog run` trained: the mean over four training panoramas; and for streets of
random Gaussians. Prints the pairs next to those that `panolog.workers.device_memory` assumes. The CPU kernels
count them: their footprints and tiles are those of a GPU.
"""

import argparse
import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from benchmarks.rasterizer.cases import street, street_camera
from panolog.renderer import ops
from panolog.renderer.camera import Camera
from panolog.scene.gaussians import Gaussians
from panolog.scene.ply import read_ply
from panolog.scene.read import read_scene
from panolog.workers import device_memory
from panolog.workers.training.config import TrainConfig
from panolog.workers.training.initialise import near_distance

_VIEWS = 4


def pairs(gaussians: Gaussians, camera: Camera, near: float) -> int:
    """Pairs of splats and tiles of one panorama."""
    screen = gaussians.means.new_zeros(len(gaussians), 2)
    settings = {"sh_degree": 0, "near": near, "exact": gaussians.exact, "exterior": []}
    *_, slots, _, _ = ops.rasterize(**gaussians.tensors(), screen=screen, **vars(camera), **settings)
    return int(slots[-1])


def _row(name: str, gaussians: Gaussians, cameras: Sequence[Camera], near: float) -> dict[str, Any]:
    count, pixels = len(gaussians), cameras[0].width * cameras[0].height
    found = sum(pairs(gaussians, camera, near) for camera in cameras) / len(cameras)
    return {
        "model": name,
        "gaussians": count,
        "width": cameras[0].width,
        "pairs": found / count,
        "assumed": device_memory.pairs(count, pixels) / count,
    }


def rows(options: argparse.Namespace) -> Iterator[dict[str, Any]]:
    """Pairs for each Gaussian, measured and assumed."""
    for model, folder in zip(options.files[::2], options.files[1::2], strict=True):
        gaussians, scene = read_ply(model), read_scene(folder)
        views = [scene.panoramas[i] for i in scene.train[:: max(1, len(scene.train) // _VIEWS)]]
        near = near_distance(scene, TrainConfig())
        for width in options.width:
            cameras = [Camera.of(view.rotation, view.translation, width, width // 2) for view in views]
            yield _row(folder.name, gaussians, cameras, near)
    for count in options.random:
        gaussians = street(count)
        for width in options.width:
            yield _row("random street", gaussians, [street_camera(width)], 0.0)


def _numbers(text: str) -> list[int]:
    return [int(number) for number in text.split(",")]


def main(arguments: Sequence[str] | None = None) -> None:
    """Prints one line for each model and width."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument(
        "files", nargs="*", type=Path, help="models (PLY), each followed by its scene's folder"
    )
    parser.add_argument("--width", type=_numbers, default=[1024, 2048, 4096], help="of panoramas, in pixels")
    parser.add_argument("--random", type=_numbers, default=[], help="numbers of random Gaussians")
    parser.add_argument("--json", action="store_true", help="one JSON array on stdout")
    options = parser.parse_args(arguments)
    if options.json:
        print(json.dumps(list(rows(options))))
        return
    for row in rows(options):
        size = f"{row['gaussians']:>10,} Gaussians at width {row['width']}"
        print(f"{row['model']:16}{size}: {row['pairs']:6.2f} pairs each, {row['assumed']:6.2f} assumed")


if __name__ == "__main__":
    main()
