"""Depth maps and sky masks for the panoramas of a scene, by a network; an interrupted job can be resumed.

Each file appears whole and records its provenance. A second call makes the files that are missing, damaged or
made by another network, and no others. Files of the user are never overwritten.
"""

from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from panolog.prepare.networks.inverse_depth import make_layers
from panolog.prepare.networks.manifest import DepthManifest, manifest_path, read_manifest
from panolog.prepare.networks.network import Network, model_digest, run_all
from panolog.prepare.networks.seam import network_images
from panolog.prepare.panorama_files import PanoramaFile, load_resized, prefetch
from panolog.prepare.provenance import Provenance, is_user_file, png_with_provenance, read_provenance
from panolog.scene.errors import ConfigError
from panolog.scene.files import write_bytes
from panolog.scene.read import DEPTHS, SKY_MASKS
from panolog.scene.write import Progress, no_progress

BATCH = 2  # images at once: one panorama and the same turned


@dataclass(frozen=True)
class DepthJob:
    """The panoramas that need a depth map, and the network."""

    network: Network
    manifest: DepthManifest
    key: str  # digest of model and manifest, for the provenance of files
    todo: tuple[PanoramaFile, ...]
    done: int  # panoramas whose maps are there, made by this network
    given: int  # panoramas whose maps a user made

    @property
    def writes_sky(self) -> bool:
        """Whether sky masks are written."""
        return self.manifest.sky is not None or self.manifest.confidence is not None


def plan_depth(pictures: Sequence[PanoramaFile], model: Path, device: str = "auto") -> DepthJob:
    """Opens the network and finds out which maps exist already.

    Raises InputError: the model, its manifest or the device cannot be used.
    """
    path = manifest_path(model)
    manifest = read_manifest(path, DepthManifest)
    heads = (manifest.depth, manifest.sky, manifest.confidence)
    outputs = list(dict.fromkeys(head.output for head in heads if head is not None))
    network = Network(model, manifest.input, outputs, device)
    key = model_digest(model, path)
    job = DepthJob(network, manifest, key, todo=(), done=0, given=0)
    states = [_state(picture, job) for picture in pictures]
    todo = tuple(picture for picture, state in zip(pictures, states, strict=True) if state == "todo")
    return replace(job, todo=todo, done=states.count("done"), given=states.count("given"))


def make_depth(job: DepthJob, batch: int = BATCH, progress: Progress = no_progress) -> None:
    """Estimates and writes the maps; can be interrupted at any moment and called again.

    Args: batch, images that the network gets at once, unless the model has a batch size of its own; progress,
    called after each panorama.

    Raises InputError: a panorama is damaged, or an output is not what the manifest says; RunError: the
    network failed.
    """
    given, done = job.manifest.input, 0
    many = max(1, (job.network.batch or batch) // (2 if given.seam == "turn" else 1))
    loaded = prefetch(lambda picture: load_resized(picture.path, 2 * given.height), job.todo)
    with closing(loaded) as images:  # also where the network fails: its thread ends
        for group in iter(lambda: list(islice(images, many)), []):
            pictures = [network_images(image, given) for _, image in group]
            outputs, each = run_all(job.network, np.concatenate(pictures), batch), len(pictures[0])
            for index, (picture, _) in enumerate(group):
                part = slice(index * each, (index + 1) * each)
                _write(picture, {name: it[part] for name, it in outputs.items()}, job)
                done += 1
                progress(done, len(job.todo))


def _state(picture: PanoramaFile, job: DepthJob) -> str:
    """Whether a panorama's map is "given", "done" or "todo"."""
    path = picture.layer(DEPTHS)
    if picture.colmap_layer(DEPTHS).is_file() and not path.is_file():
        return "given"
    if is_user_file(path):
        return "given"
    intact = read_provenance(path) == Provenance(job.key, "intact")
    return "done" if intact and (not job.writes_sky or picture.layer(SKY_MASKS).is_file()) else "todo"


def _write(picture: PanoramaFile, outputs: dict[str, NDArray[np.float32]], job: DepthJob) -> None:
    """Writes the sky mask first: where the depth map exists, both do."""
    try:
        made = make_layers(outputs, job.manifest)
    except ConfigError as error:
        raise ConfigError(f"{job.network.model}: {error}") from error
    files = {SKY_MASKS: made.sky, DEPTHS: made.inverse}
    for folder, pixels in files.items():
        path = picture.layer(folder)
        taken = is_user_file(path) or picture.colmap_layer(folder).is_file()
        if pixels is not None and not taken:
            path.parent.mkdir(parents=True, exist_ok=True)
            write_bytes(path, png_with_provenance(pixels, job.key))
