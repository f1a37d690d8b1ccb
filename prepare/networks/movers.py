"""People, cars and other movers, found in panoramas by a segmentation network."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from panolog.prepare.networks.manifest import Classes, Ignore, MaskManifest, manifest_path, read_manifest
from panolog.prepare.networks.network import Network, model_digest, run_all
from panolog.prepare.networks.seam import Floats, blend, network_images
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
        self.width = 2 * manifest.input.height  # columns of the panoramas that `find` takes

    def find(self, panorama: NDArray[np.uint8]) -> NDArray[np.bool_]:
        """(h, 2h) True = ignore, of a panorama (width / 2, width, 3) RGB.

        Raises ConfigError: an output is not what the manifest says; RunError: the network failed.
        """
        output = run_all(self._network, network_images(panorama, self._given), self._batch)[self._head.output]
        try:
            if isinstance(self._head, Classes):
                ignored = _winners(self._head, output, 1 if self._given.layout == "NCHW" else 3)
            else:
                ignored = _beyond(self._head, output)
            found = blend(ignored.astype(np.float32), self._given)
        except ValueError as error:
            raise ConfigError(f"{self._network.model}: output {self._head.output}: {error}") from error
        return found >= 0.5


def _winners(head: Classes, scores: Floats, axis: int) -> NDArray[np.bool_]:
    """(K, h, w) where a class to be ignored has the greatest score. Raises ValueError on a wrong shape."""
    if scores.ndim != 4:
        raise ValueError(f"{scores.shape} has no axis of classes")
    if max(head.ignore) >= scores.shape[axis]:
        raise ValueError(f"there is no class {max(head.ignore)} among {scores.shape[axis]}")
    return np.isin(scores.argmax(axis=axis), head.ignore)


def _beyond(head: Ignore, values: Floats) -> NDArray[np.bool_]:
    """(K, h, w) on the side of the threshold that is to be ignored. Raises ValueError on a wrong shape."""
    if values.ndim == 4:
        values = values.squeeze(1 if values.shape[1] == 1 else 3)
    if values.ndim != 3:
        raise ValueError(f"{values.shape} is not one channel for each image")
    above = values > head.threshold
    return np.asarray(above if head.above == "ignore" else ~above)
