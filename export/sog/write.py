"""SOG, version 2, written: lossless WebP images with their meta.json, all in one ZIP.

Equal Gaussians give equal bytes: times in the ZIP are fixed, and no sum depends on the order of threads.
"""

import io
import json
import os
import zipfile
from concurrent.futures import Executor, ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from panolog.export.sog.layers import Layers, make_layers
from panolog.export.sog.whole_folder import GENERATOR, META
from panolog.export.splats import SplatSource
from panolog.scene.errors import FormatError
from panolog.scene.files import StrPath, atomic

MOST = 2**25  # Gaussians of a file; a viewer needs levels of detail long before
_THREADS = 4  # at most: each holds some pieces of the model
_EPOCH = (1980, 1, 1, 0, 0, 0)  # the earliest time that a ZIP can state
# Of libwebp, lossless. On a street, 12.25 bytes and 0.3 µs for each Gaussian; method 4 saves 0.1 % in four
# times as long, method 0 takes a third of the time and 11 % more bytes.
_METHOD, _QUALITY = 1, 0


def write_sog(path: StrPath, source: SplatSource) -> None:
    """Writes Gaussians as one .sog file, atomically, in Morton order.

    Raises FormatError: there are no Gaussians, or more than `MOST`; OSError: the file cannot be written.
    """
    with threads() as pool, atomic(Path(path)) as temporary:
        files = encode(source, pool)
        with zipfile.ZipFile(temporary, "w", zipfile.ZIP_STORED, allowZip64=False) as archive:
            for name, data in files.items():
                entry = zipfile.ZipInfo(name, _EPOCH)
                entry.create_system, entry.external_attr = 3, 0o644 << 16  # on every system
                archive.writestr(entry, data)


def threads() -> Executor:
    """A pool of as many threads as there are cores, up to `_THREADS`, for `with`."""
    return ThreadPoolExecutor(min(_THREADS, len(os.sched_getaffinity(0))))


def encode(source: SplatSource, pool: Executor, *, sort: bool = True) -> dict[str, bytes]:
    """The files of a SOG by name: images, then meta.json.

    Args: source; pool, threads to use; sort, whether in Morton order or in that of the source.
    Raises FormatError as `write_sog`.
    """
    if not 0 < source.count <= MOST:
        reason = "nothing is selected" if not source.count else "export levels of detail that stream"
        raise FormatError(f"a SOG file has 1 to {MOST:,} Gaussians, these are {source.count:,}: {reason}")
    layers = make_layers(source, pool, sort=sort)
    meta = _meta(layers)
    images = {
        name: layers.pixels.pop(name).reshape(-1, layers.width, channels)
        for name, channels in [(name, pixels.shape[1]) for name, pixels in layers.pixels.items()]
    }
    if layers.palette is not None:
        images["shN_centroids"] = layers.palette.pixels
    files = dict(zip(images, pool.map(_webp, images.values()), strict=True))
    return {f"{name}.webp": data for name, data in files.items()} | {META: json_bytes(meta)}


def json_bytes(value: dict[str, Any]) -> bytes:
    """A value as JSON without spaces. Raises ValueError if a number is not finite."""
    return json.dumps(value, separators=(",", ":"), allow_nan=False).encode()


def numbers(values: NDArray[np.float32]) -> list[float]:
    """The shortest decimals that are these numbers in float32."""
    return [float(str(value)) for value in values.astype(np.float32)]


def _meta(layers: Layers) -> dict[str, Any]:
    meta: dict[str, Any] = {
        "version": 2,
        "asset": {"generator": GENERATOR},
        "count": layers.count,
        "antialias": False,
        "means": {
            "mins": layers.mins.tolist(),
            "maxs": layers.maxs.tolist(),
            "files": ["means_l.webp", "means_u.webp"],
        },
        "scales": {"codebook": numbers(layers.scales), "files": ["scales.webp"]},
        "quats": {"files": ["quats.webp"]},
        "sh0": {"codebook": numbers(layers.sh0), "files": ["sh0.webp"]},
    }
    if layers.palette is not None:
        meta["shN"] = {
            "count": layers.palette.count,
            "bands": layers.palette.degree,
            "codebook": numbers(layers.palette.codebook),
            "files": ["shN_centroids.webp", "shN_labels.webp"],
        }
    return meta


def _webp(pixels: NDArray[np.uint8]) -> bytes:
    """(H, W, 3 or 4) pixels as a lossless WebP, also of colours that are transparent."""
    buffer = io.BytesIO()
    options = {"lossless": True, "exact": True, "method": _METHOD, "quality": _QUALITY}
    Image.fromarray(pixels).save(buffer, "WEBP", **options)
    return buffer.getvalue()
