"""What stitching costs: a scene filmed by two fisheye lenses that are known, against its true panoramas.

    python -m benchmarks.stitched SCENE -o FOLDER [--rim 0.6] [--width 512] [--iterations 1500]

SCENE has known poses. Its panoramas, at 2048 pixels, are shown by two double spheres that differ in centre,
scale, projection, brightness and by a small turn, with noise and a fall-off of light, and become JPEG and a
video. `panolog scene stitch` stitches both, `panolog scene sfm` finds poses of the true and of the stitched
panoramas. Stage I of the true and of the stitched ones, by known poses and by those of SfM, is measured on
the true panoramas that are held out. FOLDER keeps what is done.
"""

import argparse
import json
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import cv2
import numpy as np

import panolog
from benchmarks import report
from benchmarks.runs import panolog as command
from panolog.prepare.sfm.trajectory import fit_world
from panolog.prepare.stitching.lenses import read_pairs
from panolog.scene.errors import RunError
from panolog.scene.files import write_bytes
from panolog.scene.image_files import decode_colors
from panolog.scene.model import Scene
from tests.prepare.stitching.cameras import Camera, camera, errors, write

FULL = 2048  # pixels of a panorama, in which errors are counted
GOAL = 1.0  # dB that the stitched panoramas may cost, and pixels that they may be off in the overlap
_FRAMES = "16"  # of the video
_METRICS = ("psnr", "ws_psnr", "ssim", "cc_psnr")


@dataclass(frozen=True)
class Overlap:
    """How far lenses that were found are from the true ones where both show something, in pixels."""

    source: str
    rms: float
    most: float
    apart: float  # from each other, at most


def photograph(scene: Scene, folder: Path, known: Camera) -> list[Path]:
    """Writes what both lenses show of each panorama; those that are there are kept."""
    folder.mkdir(parents=True, exist_ok=True)
    files = [folder / f"{it.stem}.jpg" for it in scene.panoramas]
    for seed, (file, panorama) in enumerate(zip(files, scene.panoramas, strict=True)):
        if not file.is_file():
            size = (FULL, FULL // 2)
            view = cv2.resize(decode_colors(panorama.image), size, interpolation=cv2.INTER_CUBIC)
            picture = known.picture(np.asarray(view, np.uint8), seed)
            write_bytes(file, cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, 95])[1].tobytes())
    return files


def overlap(source: str, stitched: Path, known: Camera) -> Overlap:
    """How far the lenses of a folder of stitched panoramas are from the known ones, in the overlap."""
    (found,) = read_pairs(stitched / "lenses.json")
    off, apart = errors(known, found.resized((known.size, known.size)), FULL)
    return Overlap(source, float(np.sqrt((off**2).mean())), float(off.max()), float(apart.max()))


def bare(scene: Scene, images: Path | None = None) -> Scene:
    """A scene without depth and masks, so that all have the same; its images those of a folder, if given."""
    panoramas = [replace(it, depth=None, depth_affine=None, sky_mask=None) for it in scene.panoramas]
    if images is not None:
        panoramas = [replace(it, image=images / f"{it.stem}.jpg") for it in panoramas]
    return replace(scene, panoramas=tuple(panoramas))


def held_out(truth: Scene, trained: Scene) -> Scene:
    """The true panoramas, where they are in the world of a scene whose poses are others."""
    rows = {it.stem: row for row, it in enumerate(truth.panoramas)}
    places = truth.centers[[rows[it.stem] for it in trained.panoramas]]
    fitted = fit_world(places, trained.centers)
    if fitted is None or len(places) < len(rows):
        raise RunError(f"{trained.root}: SfM has posed {len(places)} of {len(rows)} panoramas")
    poses = fitted[0].poses(truth.poses[:, :, :3], truth.poses[:, :, 3])
    moved = [replace(it, rotation=r, translation=t) for it, r, t in zip(truth.panoramas, *poses, strict=True)]
    return replace(truth, panoramas=tuple(moved))


def posed(images: Path, output: Path) -> Scene:
    """The scene that `panolog scene sfm` makes of panoramas."""
    if not output.exists():
        command("scene", "sfm", str(images), "-o", str(output))
    return panolog.read_scene(output)


def quality(name: str, scene: Scene, truth: Scene, options: argparse.Namespace) -> dict[str, float]:
    """Trains Stage I of a scene, and measures it on true panoramas in its world; what is done is read."""
    file: Path = options.output / f"{name}-{options.width}-{options.iterations}.json"
    if not file.is_file():
        config = panolog.RunConfig(width=options.width, iterations=options.iterations)
        *_, trained = panolog.train(scene, config)
        assert isinstance(trained, panolog.Trained)
        panolog.write_ply(file.with_suffix(".ply"), trained.gaussians)
        mean = panolog.evaluate(trained.gaussians, truth, width=options.width)["mean"]
        write_bytes(file, json.dumps({it: mean[it] for it in _METRICS}).encode())
    found: dict[str, float] = json.loads(file.read_bytes())
    print(name, found, file=sys.stderr, flush=True)
    return found


def measure(options: argparse.Namespace) -> report.Report:
    """Stitches stills and a video of a scene, and trains on true and on stitched panoramas."""
    folder: Path = options.output
    truth = bare(panolog.read_scene(options.scene))
    known = camera(FULL // 2, turned=0.7, rim=options.rim)
    files = photograph(truth, folder / "raw", known)
    command("scene", "stitch", str(folder / "raw"), "-o", str(folder / "stitched"))
    overlaps = [overlap("stills", folder / "stitched", known)]
    if not (folder / "frames").exists():
        video = write(folder / "walk.mp4", [decode_colors(it) for it in files])
        command("scene", "stitch", str(video), "-o", str(folder / "frames"), "--frames", _FRAMES)
    overlaps.append(overlap("video", folder / "frames", known))
    print(*overlaps, sep="\n", file=sys.stderr, flush=True)
    stitched = folder / "stitched"
    models = {
        ("true", "known"): quality("true-known", truth, truth, options),
        ("stitched", "known"): quality("stitched-known", bare(truth, stitched), truth, options),
    }
    for name, images in (("true", options.scene / "images"), ("stitched", stitched)):
        scene = posed(images, folder / f"{name}-sfm")
        models[name, "SfM"] = quality(f"{name}-sfm", bare(scene), held_out(truth, scene), options)
    rows = [(*key, *(found[it] for it in _METRICS)) for key, found in models.items()]
    costs = [models["true", it]["psnr"] - models["stitched", it]["psnr"] for it in ("known", "SfM")]
    lenses = report.markdown(
        ("lenses of", "rms px", "most px", "apart px"), [tuple(asdict(it).values()) for it in overlaps]
    )
    table = report.markdown(("panoramas", "poses", "PSNR", "WS-PSNR", "SSIM", "PSNR after the fit"), rows)
    passed = max(costs) <= GOAL and all(it.most < GOAL for it in overlaps)
    content = {"overlap": [asdict(it) for it in overlaps], "models": [list(it) for it in rows]}
    return report.Report(content, f"{lenses}\n\n{table}", passed)


def main(arguments: Sequence[str] | None = None) -> int:
    """The program; returns its exit code."""
    parser = report.parser("stitched", __doc__, quick=False)
    parser.add_argument("scene", type=Path, metavar="SCENE", help="with known poses")
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="FOLDER")
    parser.add_argument("--rim", type=float, default=0.6, help="values at the rim over those at the middle")
    parser.add_argument("--width", type=int, default=512)
    parser.add_argument("--iterations", type=int, default=1500)
    options = parser.parse_args(arguments)
    return report.run("stitched", options, lambda: measure(options))


if __name__ == "__main__":
    sys.exit(main())
