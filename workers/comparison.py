"""Whether a block is better than what it started from, on panoramas that train it and on others that see it.

A block sees few panoramas often: it may fit them at the cost of all others, for which the merged model has
its Gaussians too. So it has an advantage on its own panoramas, and Stage I on the others, which it has
trained on. Hence as many of one kind as of the other are compared: by the others alone nearly every block
would be refused, also those that are better on panoramas that nothing has trained on.
"""

from collections.abc import Callable, Generator, Sequence

import numpy as np
import torch

from panolog.partition.cells import Volume
from panolog.renderer.process import release_memory
from panolog.renderer.render import render_bytes
from panolog.scene.gaussians import Gaussians, concatenate
from panolog.scene.images import View, exposed
from panolog.scene.model import Panorama
from panolog.workers.events import Event, Notice
from panolog.workers.merge import retained
from panolog.workers.metrics import decibel, sphere_weights
from panolog.workers.sound_views import SoundViews, open_cache
from panolog.workers.specs import Source, TaskSpec

_IMAGE_MEMORY = 2**30  # bytes of decoded panoramas; each one is needed twice


def better_block(
    spec: TaskSpec,
    rows: Sequence[int],
    initial: Source[Gaussians],
    cell: Volume,
    block: Gaussians,
    near: float,
    stop: Callable[[], bool],
) -> Generator[Event, None, Gaussians | None]:
    """What a block contributes to the merged model: itself, or what was in its cell before.

    It is Stage I or, in a pass over the blocks' union, that; the cell is then perhaps the margin of a face.
    Compared are the squared errors of that model and of one with the block in its cell, summed over
    the panoramas with pixels weighed by their area on the sphere. In a row they are integers: the number of
    threads does not change the decision. Besides the block one model is in memory at a time.

    Args: rows of scene.panoramas to compare on; initial, the model before; block, its retained set (eq. 12);
    near in world units.
    Yields LeftOut for panoramas that cannot be decoded, a Notice if the block is not taken. Returns None if
    `stop` returns True before the decision. Raises SceneError if a panorama cannot be read.
    """
    scene = spec.scene.load()
    errors: list[dict[int, tuple[float, float]]] = []  # by row: before, then with the block
    with open_cache(spec, scene, rows, _IMAGE_MEMORY) as cache:
        views = SoundViews(spec.task, scene, rows, cache, damaged=1.0)
        for part in (None, block):
            model = initial.load() if part is None else with_block(initial.load(), cell, part)
            model, found = model.to(spec.device), {}
            for at, row in enumerate(rows):
                if stop():
                    return None
                cache.prefetch(rows[at : at + 1 + cache.ahead(1)])
                view = views.get(row)
                yield from views.notices()
                if view is not None:
                    found[row] = squared_error(model, scene.panoramas[row], view, near)
            errors.append(found)
            del model
            release_memory()
    measured = [row for row in rows if row not in views.left_out]
    before, after = (np.array([found[row] for row in measured]).reshape(-1, 2).sum(0) for found in errors)
    if after[0] <= before[0]:
        return block
    kept, worse = (decibel(error / area) for error, area in (before, after))
    message = (
        f"keeps what it started from: on {len(measured)} panoramas that see its part of the place that has"
        f" {kept:.2f} dB, what it has trained {worse:.2f} (WS-PSNR; stage2.compare)"
    )
    yield Notice(spec.task, message)
    return retained(initial.load(), cell, 0.0)


def with_block(coarse: Gaussians, cell: Volume, block: Gaussians) -> Gaussians:
    """The Stage I model with a block in its cell, as the merge would make it if all others kept theirs."""
    within = cell.contains(coarse.means[coarse.scene].numpy())
    outside = torch.ones(len(coarse), dtype=torch.bool)
    outside[coarse.scene] = torch.from_numpy(~within)
    return concatenate(block, coarse.select(outside))


def squared_error(model: Gaussians, panorama: Panorama, view: View, near: float) -> tuple[float, float]:
    """The squared error of colours in [0, 1] over the pixels of a view that count, and their number.

    Of colours as the view's exposure has them.

    Both weighed by area: their quotient is the mean squared error of WS-PSNR.
    """
    width = view.image.shape[1]
    render = render_bytes(model, panorama.rotation, panorama.translation, width, near)
    squared = (exposed(render, view.exposure).to(torch.int32) - view.image).square_().sum(2)
    valid = torch.ones_like(squared, dtype=torch.bool) if view.mask is None else view.mask
    sums = torch.stack([(squared * valid).sum(1), valid.sum(1)]).cpu().numpy()
    error, area = sums.astype(np.float64) @ sphere_weights(len(squared))
    return float(error / (3 * 255**2)), float(area)
