"""What passers-by cost, and what is found of them: figures are drawn into the panoramas of an empty place.

    python -m benchmarks.movers SCENE -o CROWD          # the scene with figures, for runs of your own
    python -m benchmarks.movers SCENE -o CROWD --train --width 512 --iterations 500 --seeds 0,1,2

With --train, Stage I is trained on SCENE and on CROWD, each without masks and with `movers.weigh`, and on
CROWD with masks of just the figures: nothing that finds movers can do better. Held-out panoramas have no
figures. Where figures were drawn, the model is also compared with the photographs before that.

A training of another seed differs by about 0.1 dB, and what changes a few pixels changes all that follows as
much as another seed does. So differences are of trainings of the same seed, and the second table has their
mean over seeds with its standard error: ten seeds tell 0.1 dB.
"""

import sys
import tempfile
from collections.abc import Sequence
from dataclasses import asdict, astuple, dataclass, replace
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

import panolog
from benchmarks import report
from benchmarks.movers.paste import FIGURES, paste
from panolog.orchestrator.run.config import RunConfig
from panolog.renderer.render import render_panorama
from panolog.scene.gaussians import Gaussians
from panolog.scene.image_files import decode, decode_panorama, resize
from panolog.scene.model import Scene
from panolog.scene.read import read_scene
from panolog.workers.capture.captured import Captured
from panolog.workers.events import Trained
from panolog.workers.training.initialise import near_distance

HEAD = ("scene", "masks", "seed", "PSNR", "WS-PSNR", "PSNR at figures", "found", "false", "seconds")
SUMMARY = ("scene", "masks", "seeds", "PSNR", "to clean", "± s.e.", "PSNR at figures", "found", "false")
Masks = Literal["none", "found", "perfect"]
TRAININGS: tuple[tuple[str, Masks], ...] = (
    ("clean", "none"),
    ("clean", "found"),
    ("figures", "none"),
    ("figures", "found"),
    ("figures", "perfect"),
)
_MOST = 0.9  # part of a pixel that must be a figure's


@dataclass(frozen=True)
class Result:
    """One training."""

    scene: str
    masks: Masks
    seed: int
    psnr: float  # dB, held-out panoramas
    ws_psnr: float
    figures: float  # dB, where there are figures, against the photographs without them
    found: float | None  # part of the figures' pixels
    false: float | None  # part of all other pixels
    seconds: float


def measure(clean: Scene, crowd: Scene, config: RunConfig, seeds: Sequence[int]) -> list[Result]:
    """All trainings. Raises InputError or RunError as training does."""
    return [
        _trained(name, masks, clean, crowd, config.model_copy(update=_changes(masks == "found", seed)))
        for seed in seeds
        for name, masks in TRAININGS
    ]


def summary(results: Sequence[Result]) -> list[tuple[object, ...]]:
    """A row of `SUMMARY` for each kind of training: means over seeds."""
    rows = list[tuple[object, ...]]()
    clean = {result.seed: result.psnr for result in results if (result.scene, result.masks) == TRAININGS[0]}
    for name, masks in TRAININGS:
        of = [result for result in results if (result.scene, result.masks) == (name, masks)]
        apart = [result.psnr - clean[result.seed] for result in of]
        error = float(np.std(apart, ddof=1) / np.sqrt(len(of))) if len(of) > 1 else None
        means = (np.mean([getattr(result, key) for result in of]) for key in ("psnr", "figures"))
        psnr, at_figures = map(float, means)
        shares = [_mean([getattr(result, key) for result in of]) for key in ("found", "false")]
        rows.append((name, masks, len(of), psnr, float(np.mean(apart)), error, at_figures, *shares))
    return rows


def _mean(shares: Sequence[float | None]) -> float | None:
    known = [share for share in shares if share is not None]
    return float(np.mean(known)) if known else None


def _changes(weigh: bool, seed: int) -> dict[str, object]:
    return {"seed": seed, "movers": RunConfig().movers.model_copy(update={"weigh": weigh})}


def _trained(name: str, masks: Masks, clean: Scene, crowd: Scene, config: RunConfig) -> Result:
    width = config.width or crowd.width
    drawn = {row: _figures(crowd.root / FIGURES, crowd, row, width) for row in crowd.train}
    scene = clean if name == "clean" else _without(crowd, drawn) if masks == "perfect" else crowd
    *_, last = panolog.train(scene, config)
    assert isinstance(last, Trained)
    metrics = panolog.evaluate(last.gaussians, clean, width=width)["mean"]
    found, false = None, None
    if masks == "found":
        found, false = _hits(last.captured, drawn if name == "figures" else {}, width)
    at_figures = _at_figures(last.gaussians, clean, drawn, near_distance(clean, config))
    quality = metrics["psnr"], metrics["ws_psnr"], at_figures
    return Result(name, masks, config.seed, *quality, found, false, last.seconds)


def _without(scene: Scene, drawn: dict[int, NDArray[np.float32]]) -> Scene:
    """A scene in which the pixels (H, W) of figures are left out."""
    panoramas = list(scene.panoramas)
    for row, part in drawn.items():
        panoramas[row] = replace(panoramas[row], movers=part > 0)
    return replace(scene, panoramas=tuple(panoramas))


def _figures(folder: Path, scene: Scene, row: int, width: int) -> NDArray[np.float32]:
    """(H, W) part of each pixel that is of a figure or its shadow."""
    path = folder / f"{scene.panoramas[row].stem}.png"
    if not path.exists():
        return np.zeros((width // 2, width), np.float32)
    mask = decode(path, cv2.IMREAD_GRAYSCALE)
    return np.asarray(resize(mask.astype(np.float32) / 255, (width, width // 2)), np.float32)


def _hits(
    movers: Captured | None, drawn: dict[int, NDArray[np.float32]], width: int
) -> tuple[float | None, float]:
    """Parts of the figures' pixels and of the others that are taken for movers."""
    assert movers is not None and movers.movers is not None
    counts = np.zeros((2, 2))
    for row, cells in zip(movers.rows.tolist(), movers.movers, strict=True):
        size = width, width // 2
        moving = cv2.resize(cells.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST) > 0
        part = drawn.get(row, np.zeros(moving.shape))
        for at, where in enumerate((part > _MOST, part == 0)):
            counts[at] += moving[where].sum(), where.sum()
    (hit, figures), (missed, others) = counts.tolist()
    return hit / figures if figures else None, missed / others


def _at_figures(model: Gaussians, clean: Scene, drawn: dict[int, NDArray[np.float32]], near: float) -> float:
    """PSNR of a model, in dB, where figures were drawn."""
    squares, count = 0.0, 0
    for row, part in drawn.items():
        inside = part > _MOST
        if inside.any():
            panorama, width = clean.panoramas[row], part.shape[1]
            shown = render_panorama(model, panorama.rotation, panorama.translation, width, near)
            apart = shown.astype(np.float64) - decode_panorama(panorama.image, width)
            squares, count = squares + float((apart[inside] ** 2).sum()), count + 3 * int(inside.sum())
    return float(10 * np.log10(255**2 * count / squares))


def main(arguments: Sequence[str] | None = None) -> int:
    """The program; returns its exit code."""
    parser = report.parser("movers", __doc__, quick=False)
    parser.add_argument("scene", type=Path, metavar="SCENE", help="panoramas of an empty place")
    parser.add_argument("-o", "--output", type=Path, help="folder of the scene with figures")
    parser.add_argument("--share", type=float, default=0.2, help="of the training panoramas with figures")
    parser.add_argument("--seed", type=int, default=0, help="of the figures")
    parser.add_argument("--train", action="store_true", help="also measure what they cost")
    parser.add_argument("--width", type=int, default=512, help="pixels")
    parser.add_argument("--iterations", type=int, default=500)
    parser.add_argument("--seeds", type=report.numbers, default=[0], help="of the trainings")
    options = parser.parse_args(arguments)

    def work() -> report.Report:
        scene = read_scene(options.scene)
        with tempfile.TemporaryDirectory(prefix="movers-") as folder:
            output: Path = options.output or Path(folder) / "crowd"
            covered = paste(scene, output, options.share, options.seed)
            results = []
            if options.train:
                settings = {"recipe": "panolog", "width": options.width, "iterations": options.iterations}
                config = RunConfig.model_validate(settings)
                results = measure(scene, read_scene(output), config, options.seeds)
        text = (
            f"figures in {len(covered)} panoramas, on {100 * np.mean(list(covered.values())):.1f} % of each"
        )
        rows = [astuple(result) for result in results]
        if rows:
            text += f"\n\n{report.markdown(HEAD, rows)}\n\n{report.markdown(SUMMARY, summary(results))}"
        return report.Report({"covered": covered, "results": [asdict(r) for r in results]}, text)

    return report.run("movers", options, work)


if __name__ == "__main__":
    sys.exit(main())
