"""People, cars and other movers, found in panoramas by a segmentation network."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from panolog.prepare.networks.manifest import Classes, Ignore, MaskManifest, manifest_path, read_manifest
from panolog.prepare.networks.network import Network, model_digest, run_all
from panolog.prepare.networks.seam import Floats, blend, network_images
from panolog.prepare.networks.tiles import Tiles
from panolog.scene.errors import ConfigError


class MoverNetwork:
    """An opened network; `key` is the digest of its model and manifest."""

    def __init__(self, model: Path, device: str = "auto", batch: int = 2) -> None:
        """Opens it, to be given `batch` images at once.

        Raises InputError if its file, its manifest and the device do not fit together.
        """
        path = manifest_path(model)
        manifest = read_manifest(path, MaskManifest)
        self._given, self._head, self._batch = manifest.input, manifest.head, batch
        self._network = Network(model, manifest.input, [self._head.output], device)
        self.key = model_digest(model, path)
        self.device = self._network.device
        self._tiles = None if manifest.input.fov is None else Tiles(manifest.input.width, manifest.input.fov)
        # columns of the panoramas that `find` takes
        self.width = 2 * manifest.input.height if self._tiles is None else self._tiles.width

    def find(self, panorama: NDArray[np.uint8]) -> NDArray[np.bool_]:
        """(h, 2h) True = ignore, of a panorama (width / 2, width, 3) RGB.

        Raises ConfigError: an output is not what the manifest says; RunError: the network failed.
        """
        tiles, size = self._tiles, self._network.batch or self._batch
        images = network_images(panorama, self._given) if tiles is None else tiles.views(panorama)
        parts = [self._ignored(images[at : at + size]) for at in range(0, len(images), size)]
        ignored = np.concatenate(parts)
        if tiles is not None:
            return tiles.joined(ignored)
        try:
            return blend(ignored.astype(np.float32), self._given) >= 0.5
        except ValueError as error:
            raise ConfigError(f"{self._network.model}: output {self._head.output}: {error}") from error

    def _ignored(self, images: NDArray[np.uint8]) -> NDArray[np.bool_]:
        """(K, h, w) of a batch (K, height, width, 3); scores of many classes are not kept."""
        output = run_all(self._network, images, self._batch)[self._head.output]
        try:
            if isinstance(self._head, Classes):
                return _winners(self._head, output, 1 if self._given.layout == "NCHW" else 3)
            return _beyond(self._head, output)
        except ValueError as error:
            raise ConfigError(f"{self._network.model}: output {self._head.output}: {error}") from error


def _winners(head: Classes, scores: Floats, axis: int) -> NDArray[np.bool_]:
    """(K, h, w) where a class to be ignored has the greatest score, or is given as the winner.

    Raises ValueError on a wrong shape.
    """
    if scores.ndim == 3 or (scores.ndim == 4 and scores.shape[axis] == 1):
        return np.isin(_plane(scores), head.ignore)
    if scores.ndim != 4:
        raise ValueError(f"{scores.shape} has no axis of classes")
    if max(head.ignore) >= scores.shape[axis]:
        raise ValueError(f"there is no class {max(head.ignore)} among {scores.shape[axis]}")
    return np.isin(scores.argmax(axis=axis), head.ignore)


def _beyond(head: Ignore, values: Floats) -> NDArray[np.bool_]:
    """(K, h, w) on the side of the threshold that is to be ignored. Raises ValueError on a wrong shape."""
    above = _plane(values) > head.threshold
    return np.asarray(above if head.above == "ignore" else ~above)


def _plane(values: Floats) -> Floats:
    """(K, h, w) of an output with one channel, on axis 1 or 3. Raises ValueError if it has more."""
    if values.ndim == 4:
        values = values.squeeze(1 if values.shape[1] == 1 else 3)
    if values.ndim != 3:
        raise ValueError(f"{values.shape} is not one channel for each image")
    return values
