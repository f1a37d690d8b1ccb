"""People, cars and other movers, found in panoramas by a segmentation network."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from panolog.prepare.networks.manifest import Classes, Ignore, MaskManifest, manifest_path, read_manifest
from panolog.prepare.networks.network import Network, model_digest, run_all
from panolog.prepare.networks.seam import Floats, blend, named, network_images, plane
from panolog.prepare.networks.square_views import Tiles


class MoverNetwork:
    """An opened `network`; `key` is the digest of its model and manifest."""

    def __init__(self, model: Path, device: str = "auto", batch: int = 2) -> None:
        """Opens it, to be given `batch` images at once.

        Raises InputError if its file, its manifest and the device do not fit together.
        """
        path = manifest_path(model)
        manifest = read_manifest(path, MaskManifest)
        self._given, self._head, self._batch = manifest.input, manifest.head, batch
        self.network = Network(model, manifest.input, [self._head.output], device)
        self._output = f"{model}: output {self._head.output}"
        self.key = model_digest(model, path)
        self._tiles = None if manifest.input.fov is None else Tiles(manifest.input.width, manifest.input.fov)
        # columns of the panoramas that `find` takes
        self.width = 2 * manifest.input.height if self._tiles is None else self._tiles.width

    def find(self, panorama: NDArray[np.uint8]) -> NDArray[np.bool_]:
        """(h, 2h) True = ignore, of a panorama (width / 2, width, 3) RGB.

        Raises ConfigError: an output is not what the manifest says; RunError: the network failed.
        """
        tiles, size = self._tiles, self.network.batch or self._batch
        images = network_images(panorama, self._given) if tiles is None else tiles.views(panorama)
        parts = [self._ignored(images[at : at + size]) for at in range(0, len(images), size)]
        ignored = np.concatenate(parts)
        if tiles is not None:
            return tiles.joined(ignored)
        with named(self._output):
            return blend(ignored.astype(np.float32), self._given) >= 0.5

    def _ignored(self, images: NDArray[np.uint8]) -> NDArray[np.bool_]:
        """(K, h, w) of a batch (K, height, width, 3); scores of many classes are not kept."""
        output = run_all(self.network, images, self._batch)[self._head.output]
        with named(self._output):
            if isinstance(self._head, Classes):
                return _winners(self._head, output, 1 if self._given.layout == "NCHW" else 3)
            return _beyond(self._head, output)


def _winners(head: Classes, scores: Floats, axis: int) -> NDArray[np.bool_]:
    """(K, h, w) where a class to be ignored has the greatest score, or is given as the winner.

    Raises ValueError on a wrong shape.
    """
    if scores.ndim == 3 or (scores.ndim == 4 and scores.shape[axis] == 1):
        return np.isin(plane(scores), head.ignore)
    if scores.ndim != 4:
        raise ValueError(f"{scores.shape} has no axis of classes")
    if max(head.ignore) >= scores.shape[axis]:
        raise ValueError(f"there is no class {max(head.ignore)} among {scores.shape[axis]}")
    return np.isin(scores.argmax(axis=axis), head.ignore)


def _beyond(head: Ignore, values: Floats) -> NDArray[np.bool_]:
    """(K, h, w) on the side of the threshold that is to be ignored. Raises ValueError on a wrong shape."""
    above = plane(values) > head.threshold
    return np.asarray(above if head.above == "ignore" else ~above)
