"""A scene whose exposure drifts: each panorama is brighter or darker in linear light, and tinted.

    python -m benchmarks.captures.exposures SCENE -o COPY [--stops 0.8] [--tint 0.05] [--seed 0]

COPY/gains.json has the gains of each panorama, RGB in linear light. Clipped as a camera clips.
"""

import argparse
import json
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from panolog.scene.model import Scene
from panolog.scene.read import read_scene
from tests.scenes import copy_scene

TRUTH = "gains.json"
PERIODS = (8, 13, 21, 34)  # panoramas: a camera follows the sky within seconds of a walk


def smooth_gains(count: int, stops: float, tint: float, seed: int) -> NDArray[np.float64]:
    """(count, 3) gains in linear light: brightness smooth over ± `stops`, channels smooth over ± `tint`."""
    random = np.random.default_rng(seed)
    time = np.arange(count)

    def curve() -> NDArray[np.float64]:
        waves = [np.sin(2 * np.pi * (time / length + random.random())) for length in PERIODS]
        value = random.uniform(0.5, 1, len(waves)) @ np.array(waves)
        value -= (value.max() + value.min()) / 2
        return np.asarray(value / np.abs(value).max())

    brightness = stops * curve()
    tints = np.stack([curve() for _ in range(3)], axis=1) * np.log2(1 + tint)
    gains: NDArray[np.float64] = np.exp2(brightness[:, None] + tints - tints.mean(axis=1, keepdims=True))
    return gains


def expose(picture: NDArray[np.uint8], gain: NDArray[np.float64]) -> NDArray[np.uint8]:
    """A picture (H, W, 3) of sRGB with gains (3,) of its channels in linear light."""
    encoded = picture / 255.0
    linear = np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4) * gain
    again = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * np.maximum(linear, 0) ** (1 / 2.4) - 0.055)
    return np.asarray(np.rint(np.clip(again, 0, 1) * 255), np.uint8)


def make(scene: Scene, output: Path, *, stops: float = 0.8, tint: float = 0.05, seed: int = 0) -> None:
    """Writes the copy. Raises OSError if the disk takes no file, InputError if `output` exists."""
    gains = smooth_gains(len(scene.panoramas), stops, tint, seed)
    rows = {panorama.name: row for row, panorama in enumerate(scene.panoramas)}

    def changed(name: str, picture: NDArray[np.uint8]) -> NDArray[np.uint8]:
        return expose(picture, gains[rows[name], ::-1])  # OpenCV's pictures are BGR

    copy_scene(scene, output, changed)
    truth = {panorama.name: gains[row].tolist() for row, panorama in enumerate(scene.panoramas)}
    (output / TRUTH).write_text(json.dumps(truth, indent=1))


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.captures.exposures", description=__doc__)
    parser.add_argument("scene", type=Path)
    parser.add_argument("-o", "--output", type=Path, required=True)
    parser.add_argument("--stops", type=float, default=0.8)
    parser.add_argument("--tint", type=float, default=0.05)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    kind = {"stops": options.stops, "tint": options.tint, "seed": options.seed}
    make(read_scene(options.scene), options.output, **kind)


if __name__ == "__main__":
    cv2.setNumThreads(1)
    main()
