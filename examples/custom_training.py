"""Trains the Gaussians of a scene in a loop of its own: L1 loss, Adam, no densification.

    python examples/custom_training.py SCENE MODEL.ply --iterations 200 --width 512

`panolog.train` does all that the paper does; this shows how to use the renderer with your own loss.
"""

import argparse
import random
from collections.abc import Sequence

import torch

import panolog
from panolog.scene.images import load_view
from panolog.workers.training.initialise import scene_gaussians

RATES = {"means": 1e-3, "quats": 1e-3, "scales": 5e-3, "opacities": 5e-2, "sh0": 2.5e-3, "shN": 1.25e-4}


def main(arguments: Sequence[str] | None = None) -> None:
    """Writes MODEL.ply and prints the metrics on the held-out panoramas."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("scene", metavar="SCENE")
    parser.add_argument("model", metavar="MODEL.ply")
    parser.add_argument("--iterations", type=int, default=200)
    parser.add_argument("--width", type=int, default=512, help="pixels, even")
    options = parser.parse_args(arguments)

    random.seed(0)
    device = "cuda" if torch.cuda.is_available() else "cpu"
    scene = panolog.read_scene(options.scene)
    initial = scene_gaussians(scene).to(device)  # one Gaussian for each point of the sparse cloud
    leaves = {name: tensor.requires_grad_() for name, tensor in initial.tensors().items()}
    gaussians = initial.with_tensors(leaves)
    optimizer = torch.optim.Adam([{"params": [leaf], "lr": RATES[name]} for name, leaf in leaves.items()])
    views = {row: load_view(scene.panoramas[row], row, options.width) for row in scene.train}

    for iteration in range(1, options.iterations + 1):
        row = random.choice(scene.train)
        panorama, image = scene.panoramas[row], views[row].image.to(device) / 255  # (H, W, 3)
        camera = panolog.Camera.of(panorama.rotation, panorama.translation, options.width, options.width // 2)
        loss = (panolog.render(gaussians, camera.to(device)).color - image).abs().mean()
        optimizer.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        optimizer.step()
        if iteration % 50 == 0 or iteration == options.iterations:
            print(f"iteration {iteration}: L1 {loss.item():.4f}")

    trained = initial.with_tensors({name: leaf.detach() for name, leaf in leaves.items()})
    panolog.write_ply(options.model, trained)
    print(panolog.evaluate(trained, scene, width=options.width, device=device)["mean"])


if __name__ == "__main__":
    main()
