"""Recipes: presets of ordinary settings. A run's own settings win over those of its recipe.

`paper` is the paper to the letter, and 3DGS where it is silent: each setting's own default. `authors` is what
the authors' public code does, which differs from their text (docs/fidelity.md). `panolog` changes what has
proven better: `python -m benchmarks.paper` measures each change alone and with the rest (docs/quality.md).
They are separate from the settings because they cover those of the whole run.
"""

from collections.abc import Mapping
from typing import Any, Literal

Recipe = Literal["paper", "authors", "panolog"]

RECIPES: Mapping[Recipe, Mapping[str, Any]] = {  # by dotted key
    "paper": {},
    "authors": {
        "initial_opacity": 0.01,
        "partition.rho_tri": 15.0,  # or 30, by scene
        "partition.min_cameras": 1,
        "depth.w0": 0.0,  # in most of its settings
        "sky.kappa": 5.0,
        "sky.size": 10**0.5,
        "sky.opacity": 0.67,
        "densify.split_gradient": 4e-4,
        "densify.least_opacity": 0.15,
        "densify.prune_scale": 0.0,
        "reset.unrisen": "kept",
        "stage2.position": 0.4,  # 6.4e-5
        "stage2.scale": 0.4,  # 2e-3
    },
    "panolog": {
        "projection": "exact",  # an affine splat is another shape where a Gaussian is near or at a pole
        "partition.tau_grad": 0.1,
        "partition.aspect": 0.5,  # the storeys of a house are in one block
        "depth.unit": "baseline",  # a weight that means the same whatever the unit of a reconstruction
        "depth.sky": True,  # nothing near may hide in the sky
        "depth.wT": 0.1,  # what only the nearest panoramas show well stays where the maps have it
        "depth.points": 0.8,  # what is plain has no sparse points, and is where holes remain
        "sh.near": 10.0,  # the ground of a path: its cameras are a few directions, and not what is between
        "loss.sphere": True,  # a pole has many pixels, and little of what is seen
        "densify.method": "relocate",  # as many Gaussians as the paper, where they are needed; no resets
        "densify.growth": 0.75,  # so that a street has no more than in the paper's recipe
        "densify.long_runs": 0.5,  # what trains longer can teach more of them
        "densify.filled": 0.25,  # early: a Gaussian needs time to learn
        "densify.weight": "gradient",  # where the error is, not where opacity is
        "densify.measure": "angle",  # no more at the poles than elsewhere
        "densify.views": "contribution",  # the mean is not diluted by views that hardly see it
        "densify.long_axis": True,  # halves lie along what is long, one maximum for both
        "densify.until": 24_000,  # relocation disturbs little, so it may last longer
        "densify.prune_opacity": 0.02,  # fainter ones are haze: they learn more elsewhere, and none is merged
        "densify.opacity_decay": 0.003,  # what no view holds up moves sooner
        "optimizer.unit": "distance",  # else what is near moves by pixels each step, and never comes to rest
        "optimizer.position": 1e-4,  # parts of that distance: by `short_runs` 2e-3 in a run of 1,500
        "optimizer.position_final": 1e-6,
        "optimizer.short_runs": 0.5,  # a short run at the rates of a long one ends before shapes arrive
        "optimizer.least_pixels": 0.3,  # what is thinner is a needle, for who comes closer
        "optimizer.largest": 1.0,  # else haze is part of the brightness of the sky, until a block removes it
        "optimizer.opacity_final": 2.5e-3,  # opacities that never rest cost what they jitter
        "optimizer.average": 0.125,  # what single views pull out of place at the end evens out
        "stage2.exterior": "baked",  # an iteration costs what a block keeps, not what it throws away
        "stage2.position": 0.3,  # positions begin near where they end
        "stage2.growth": 1.1,  # no more than in the paper's recipe, on a flight too
        "stage2.opacity_decay": 0.0,  # nor does it forget what few of its own views hold up
        "stage2.compare": 8,  # a block that overfits does not harm the model
        "passes.repair": 0.2,  # what is near a face learns from the panoramas of both of its blocks
        "sky.kappa": 100.0,  # infinitely far for all cameras: at 10, clouds move against the sky as one walks
        "sky.pixels": 8,  # a sky is plain: more than a picture can show cost time and learn slowly
        "exposure.learn": "auto",  # where panoramas differ in brightness, blocks would not fit each other
        "reset.recovery": 100,  # as a full run has: pruned is what stays transparent, not what is slow
    },
}
