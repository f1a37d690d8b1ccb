"""The Gaussians of a file as exports read them: of a PLY in pieces, of a checkpoint at once."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch

from panolog.export.frame import HALF_TURN, Frame
from panolog.export.reading import is_ply, is_spz, read_model, sky_of
from panolog.export.splats import REST, InMemory, ModelSource, Selection, Splats, SplatSource
from panolog.scene.errors import InputError
from panolog.scene.gaussians import Gaussians
from panolog.scene.ply import ply_header, read_sky
from panolog.workers.showing.previews import WHOLE
from panolog.workers.training import checkpoint
from panolog.workers.training.optimizer import gaussians_of


@dataclass(frozen=True, eq=False)
class Model:
    """Gaussians to show."""

    scene: SplatSource  # in the exported frame; the sky, if there is nothing else
    sky: Gaussians | None  # in the model's coordinates
    total: int  # Gaussians
    missing: int = 0  # of them that are not in the file
    iteration: int | None = None  # of a checkpoint


def open_model(path: Path, frame: Frame, chosen: Selection) -> Model:
    """A PLY of Gaussians, a checkpoint of this program, or an SPZ or compressed PLY.

    Args: chosen of them; which part is decided here.
    Raises InputError or RunError if it cannot be read, or has no Gaussians.
    """
    if _is_checkpoint(path):
        model = _of_checkpoint(path, frame, chosen)
    elif path.is_file() and not is_ply(path):
        model = _of_export(path, frame, chosen)
    else:
        model = _of_ply(path, frame, chosen)
    if not model.scene.count:
        raise InputError(f"{path}: has no Gaussians to show")
    return model


def _of_ply(path: Path, frame: Frame, chosen: Selection) -> Model:
    total, sky = ply_header(path)
    if sky == total:
        return Model(ModelSource(path, replace(chosen, part="all"), frame), None, total)
    source = ModelSource(path, replace(chosen, part="scene"), frame)
    return Model(source, read_sky(path) if sky else None, total)


def _of_export(path: Path, frame: Frame, chosen: Selection) -> Model:
    """A file in a format of others; its frame is theirs: SPZ is y up, and what pages show y down.

    The sky of an SPZ is in a file next to it.
    """
    splats, sky = read_model(path), None
    kept = splats.select(replace(chosen, part="all").keeps(splats, np.ones(len(splats), np.bool_)))
    if is_spz(path):
        kept = kept.turned(HALF_TURN)
        if sky_of(path).is_file():
            sky = read_model(sky_of(path)).turned(HALF_TURN).turned(frame.inverse).gaussians(exact=False)
    return Model(InMemory(kept.reduced(chosen.degree)), sky, len(splats) + (0 if sky is None else len(sky)))


def _of_checkpoint(path: Path, frame: Frame, chosen: Selection) -> Model:
    saved = checkpoint.load(path)
    gaussians = gaussians_of(saved.tensors)
    degree = min(chosen.degree, REST.index(saved.tensors["shN"].shape[1]))  # a snapshot has 0
    splats, scene = Splats.of(gaussians), (~_is_sky(gaussians)).numpy()
    selection = replace(chosen, part="scene" if scene.any() else "all")
    kept = splats.select(selection.keeps(splats, scene))
    turned = kept.reduced(degree).turned(frame)
    sky = gaussians.select(_is_sky(gaussians)) if gaussians.sky and scene.any() else None
    total = int(saved.tensors.get(WHOLE, torch.tensor(len(gaussians))))
    return Model(InMemory(turned), sky, total, total - len(gaussians), saved.iteration)


def _is_checkpoint(file: Path) -> bool:
    """Whether a file starts like safetensors: with the length of a JSON object, then the object."""
    if not file.is_file():
        return False
    with file.open("rb") as opened:
        return opened.read(9)[8:] == b"{"


def _is_sky(gaussians: Gaussians) -> torch.Tensor:
    """(N,) which of them are sky: the last ones."""
    return torch.arange(len(gaussians)) >= len(gaussians) - gaussians.sky
