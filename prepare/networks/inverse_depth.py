"""From the outputs of a depth network to the layers of a scene: inverse radial depth, sky and holes."""

import functools
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from panolog.prepare.networks.manifest import Confidence, DepthManifest, Sky
from panolog.prepare.networks.seam import Floats, blend, named, plane
from panolog.scene.depth_alignment import AlignmentError, fit_affine

FULL = 65_535  # the greatest value of a map
NEAREST = 0.25  # metres; 65535 in the maps of metric estimators, which so share one scale: 100 m is 164
TYPICAL, HEADROOM = 0.999, 4.0  # a quantile of a map; above four times it are spikes, which cost resolution
_MATCHED = 20_000  # pixels by which the turned estimate is brought to the scale of the first
_HUGE = 1e30  # in place of infinity, which arithmetic does not survive


@dataclass(frozen=True, eq=False)
class DepthLayers:
    """The layers of one panorama. h rows, twice as many columns."""

    inverse: NDArray[np.uint16]  # (h, 2h) inverse radial depth up to scale and offset; 0 = sky or hole
    sky: NDArray[np.uint8] | None  # (h, 2h) 255 foreground, 0 sky; None where the network has no such output


def make_layers(outputs: dict[str, Floats], manifest: DepthManifest) -> DepthLayers:
    """The layers of one panorama from the outputs for the images that `seam.network_images` made of it.

    Args: outputs, each (K, ...) with one channel. Sky and uncertain pixels get 0; values above 65535 are
    clamped. For a network with a confidence but no sky, the sky mask is empty: without a sky mask, 0 would
    mean sky.

    Raises ConfigError: an output has another shape than the manifest's input makes one expect.
    """
    inverse = _inverse(outputs, manifest)
    sky = _side(outputs, manifest, manifest.sky, "sky", inverse.shape)
    unsure = _side(outputs, manifest, manifest.confidence, "unsure", inverse.shape)
    if unsure is not None:
        inverse = np.where(unsure, np.float32(np.nan), inverse)
        sky = np.zeros(inverse.shape, bool) if sky is None else sky
    if sky is not None:
        inverse = np.where(sky, np.float32(np.nan), inverse)
    mask = None if sky is None else np.where(sky, 0, 255).astype(np.uint8)
    metric = manifest.depth.factor is not None
    return DepthLayers(encode_depth(inverse, 1 / NEAREST if metric else None), mask)


def encode_depth(inverse: Floats, top: float | None) -> NDArray[np.uint16]:
    """16-bit map of inverse depth (h, w): NaN becomes 0, all else 1 to 65535, with `top` at 65535.

    Without `top` it is the greatest of the map, spikes apart, and a map with negative values is shifted:
    estimators up to scale and offset may be negative far away, and their offset takes the shift up.
    """
    coded = np.zeros(inverse.shape, np.uint16)
    known = ~np.isnan(inverse)
    if not known.any():
        return coded
    values = inverse[known].astype(np.float64)
    if top is None:
        values -= min(0.0, float(values.min()))
        top = min(float(values.max()), HEADROOM * float(np.quantile(values, TYPICAL)))
    coded[known] = np.clip(np.rint(values * (FULL / top if top > 0 else 1)), 1, FULL)
    return coded


def _inverse(outputs: dict[str, Floats], manifest: DepthManifest) -> Floats:
    """(h, 2h) inverse radial depth, in 1 / metre where the manifest has a factor; NaN where there is none."""
    what = manifest.depth
    with named(f"output {what.output}"):
        raw, factor = plane(outputs[what.output]), np.float32(what.factor or 1)
        with np.errstate(divide="ignore", over="ignore"):  # too near for a number: not finite, so no value
            inverse = np.asarray(1 / (raw * factor) if what.kind == "depth" else raw / factor, np.float32)
        known = np.isfinite(inverse) & ((raw > 0) | (what.kind != "depth"))
        inverse = np.where(known, inverse, np.float32(np.nan))
        found = blend(inverse, manifest.input, match_scale if what.factor is None else None)
    return found * _radial(found.shape[0], what.distance)


@functools.cache
def _radial(height: int, distance: str) -> Floats:
    """(h, 2h) z / r of each pixel's ray: what turns inverse z into inverse radial depth."""
    elevation = (np.arange(height) + 0.5)[:, None] / height * np.pi - np.pi / 2
    azimuth = (np.arange(2 * height) + 0.5) / height * np.pi - np.pi
    flat = np.cos(elevation) * np.ones_like(azimuth)
    if distance == "radial":
        return np.ones_like(flat, np.float32)
    if distance == "cylinder":
        return flat.astype(np.float32)
    across, up = np.maximum(np.abs(np.sin(azimuth)), np.abs(np.cos(azimuth))), np.abs(np.sin(elevation))
    return np.maximum(flat * across, up).astype(np.float32)


def match_scale(second: Floats, first: Floats) -> Floats:
    """`second` (h, w), brought to the scale and offset of `first` (h, w) by the robust line between them.

    An estimator up to scale and offset gives others for a turned panorama.
    """
    both = np.flatnonzero(np.isfinite(first) & np.isfinite(second))[:: max(1, first.size // _MATCHED)]
    if len(both) < 2:
        return second
    try:
        line = fit_affine(second.ravel()[both].astype(np.float64), first.ravel()[both].astype(np.float64), 0)
    except AlignmentError:  # a constant: nothing to learn from
        return second
    if not (np.isfinite(line.scale) and np.isfinite(line.offset) and line.scale > 0):
        return second
    return np.float32(line.scale) * second + np.float32(line.offset)


def _side(
    outputs: dict[str, Floats],
    manifest: DepthManifest,
    what: Sky | Confidence | None,
    side: str,
    size: tuple[int, ...],
) -> NDArray[np.bool_] | None:
    """(h, 2h) where the output lies on the threshold's `side`; None if the manifest has no such output."""
    if what is None:
        return None
    with named(f"output {what.output}"):
        raw = np.nan_to_num(plane(outputs[what.output]), nan=np.nan, posinf=_HUGE, neginf=-_HUGE)
        values = blend(raw, manifest.input)
    if values.shape != size:  # a head of another resolution; scores are smooth, so they may be interpolated
        values = np.asarray(cv2.resize(values, size[::-1], interpolation=cv2.INTER_LINEAR), np.float32)
    above = values > what.threshold
    found = above if what.above == side else ~above
    return np.where(np.isnan(values), side == "unsure", found)
