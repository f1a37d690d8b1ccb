"""Trains the Gaussians of a scene in a loop of its own, of public names only.

    python examples/custom_training.py SCENE MODEL.ply --iterations 500 --width 512

`panolog.train` does all that the paper does; this is a place to try another loss, optimizer or strategy.
"""

import argparse
from collections.abc import Sequence
from typing import Any

import torch

import panolog

SKY = 5_000  # Gaussians that are far away
# Of Adam, higher than those of 3DGS since the run is short; that of means in extents of the cameras' path.
RATES = {"means": 1.09e-3, "quats": 8e-3, "scales": 4e-2, "opacities": 5e-2, "sh0": 7e-3, "shN": 3.5e-4}
# One reset of opacities, and some growth after it.
GROWTH: dict[str, Any] = {"until": 20_000, "reset": {"every_floor": 200, "recovery": 100}}


def train(scene: panolog.Scene, iterations: int, width: int, device: str) -> panolog.Gaussians:
    """The loop: L1, SSIM and depth, Adam, and growth as 3DGS has it."""
    model = panolog.initial_gaussians(scene, sky=SKY, width=width).to(device)
    leaves = {name: tensor.requires_grad_() for name, tensor in model.tensors().items()}
    groups = [{"params": [leaf], "lr": RATES[name]} for name, leaf in leaves.items()]
    optimizer = torch.optim.Adam(groups, eps=1e-15)
    growth = panolog.Clone3DGS(scene.centers[list(scene.train)], iterations, sky=SKY, **GROWTH)
    views = panolog.load_views(scene, width, iterations, depth=True, device=device)
    for iteration, view in enumerate(views, 1):
        progress = iteration / iterations
        optimizer.param_groups[0]["lr"] = RATES["means"] * growth.extent * 0.01**progress
        sh = torch.cat([leaves["sh0"], leaves["shN"]], 1)
        raster = panolog.rasterize(
            leaves["means"], leaves["quats"], leaves["scales"], leaves["opacities"], [view.camera], sh=sh
        )
        loss = panolog.photometric_loss(raster.color[0], view.image, view.mask).loss
        if view.depth is not None:
            depth = panolog.inverse_depth_loss(raster.inverse_depth[0], *view.depth)
            loss = loss + 0.5 * 0.02**progress * depth
        optimizer.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        leaves["means"].grad[-SKY:] = 0  # type: ignore[index]  # the sky stays where it is
        optimizer.step()
        growth.step(leaves, optimizer, raster, iteration)
        if iteration % 50 == 0:
            print(f"iteration {iteration}: loss {loss.item():.4f}, {len(leaves['means']):,} Gaussians")
    return model.with_tensors({name: leaf.detach() for name, leaf in leaves.items()})


def main(arguments: Sequence[str] | None = None) -> None:
    """Writes MODEL.ply and prints the metrics on the held-out panoramas."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("scene", metavar="SCENE")
    parser.add_argument("model", metavar="MODEL.ply")
    parser.add_argument("--iterations", type=int, default=500)
    parser.add_argument("--width", type=int, default=512, help="pixels, even")
    options = parser.parse_args(arguments)

    device = "cuda" if torch.cuda.is_available() else "cpu"
    scene = panolog.read_scene(options.scene)
    trained = train(scene, options.iterations, options.width, device)
    panolog.write_ply(options.model, trained)
    print(panolog.evaluate(trained, scene, width=options.width, device=device)["mean"])


if __name__ == "__main__":
    main()
