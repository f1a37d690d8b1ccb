"""What an SPZ holds of each Gaussian: bytes, by the same rules in all versions.

Facts from https://github.com/nianticlabs/spz (README and splat types, MIT): positions are 24-bit fixed point,
logarithms of scales 8 bits in steps of 1/16 from −10 on, opacities 8 bits, colours 8 bits of 0.5 + 0.15 c,
coefficients of spherical harmonics 8 bits of (c + 1)/2 of which only the upper ones are used, rotations the
three smallest of x y z w with 9 bits and a sign each, and 2 bits for which one is the largest.
"""

import numpy as np
from numpy.typing import NDArray

from panolog.export.splats import REST, Splats, packed_but_largest, quaternions

Bytes = NDArray[np.uint8]
Floats = NDArray[np.float32]

POSITION = 9  # bytes of one
_LARGEST = 2**23 - 1  # fixed point that 24 bits hold
_COLOR = 0.15 * 255  # steps of a coefficient of degree 0
_BUCKETS = (4, 8, 8)  # steps of 1/128 between the values of degrees 1 to 3: 6 bits, then 5
_MAGNITUDE = 511 * np.sqrt(2.0)  # steps of a component of at most √½
_FULL = 30.0  # logit that stands for an opacity of 1, and minus it for 0


def widths(degree: int, version: int) -> dict[str, int]:
    """Bytes of a Gaussian in each stream, in the order of a file; `degree` is 0 to 4, `version` 2 to 4."""
    rest = 3 * ((degree + 1) ** 2 - 1)
    rotations = 3 if version == 2 else 4
    return {"positions": POSITION, "alphas": 1, "colors": 3, "scales": 3, "rotations": rotations, "sh": rest}


def pack_positions(means: Floats, bits: int) -> Bytes:
    """(N, 9) of positions (N, 3), with so many fractional bits. Raises ValueError if one does not fit."""
    fixed = np.rint(means.astype(np.float64) * 2.0**bits)
    if len(fixed) and not np.abs(fixed).max() <= _LARGEST:
        raise ValueError("a position does not fit into 24 bits")
    return fixed.astype("<i4").view(np.uint8).reshape(-1, 3, 4)[:, :, :3].reshape(-1, POSITION)


def most_bits(extent: float) -> int:
    """Fractional bits of positions of which none has a coordinate beyond ±extent; may be negative."""
    return 23 - int(np.ceil(np.log2(max(extent, 2.0**-8) * (1 + 2.0**-22))))


def unpack_positions(packed: Bytes, bits: int) -> Floats:
    """(N, 3) of (N, 9)."""
    wide = np.zeros((len(packed), 3, 4), np.uint8)
    wide[:, :, 1:] = packed.reshape(-1, 3, 3)
    return np.asarray((wide.view("<i4")[:, :, 0] >> 8) * 2.0**-bits, np.float32)


def pack_scales(scales: Floats) -> Bytes:
    """(N, 3) of logarithms (N, 3): from −10 to 5.94."""
    return _to_bytes((scales + 10) * 16)


def unpack_scales(packed: Bytes) -> Floats:
    """(N, 3) logarithms."""
    return np.asarray(packed.astype(np.float32) / 16 - 10, np.float32)


def pack(splats: Splats) -> dict[str, Bytes]:
    """All streams (N, bytes) but that of the positions, as versions 3 and 4 have them."""
    fields = {
        "alphas": _to_bytes(255 / (1 + np.exp(-splats.opacities[:, None].astype(np.float64)))),
        "colors": _to_bytes(splats.sh0 * _COLOR + 127.5),
        "scales": pack_scales(splats.scales),
        "rotations": _pack_rotations(splats.quats),
    }
    if splats.degree:
        step = np.repeat(_BUCKETS[: splats.degree], np.diff(REST)[: splats.degree])[:, None]
        sh = np.rint(splats.shN * (128 / step)) * step + 128
        fields["sh"] = _to_bytes(sh).reshape(len(splats), -1)
    return fields


def unpack(streams: dict[str, Bytes], bits: int) -> Splats:
    """Gaussians of all streams (N, bytes). Beyond degree 3 coefficients are left out."""
    alphas = streams["alphas"][:, 0].astype(np.float64) / 255
    with np.errstate(divide="ignore"):
        opacities = np.log(alphas) - np.log1p(-alphas)
    count, rotations = len(alphas), streams["rotations"]
    sh = streams["sh"].reshape(count, -1, 3)[:, : REST[-1]]
    return Splats(
        means=unpack_positions(streams["positions"], bits),
        quats=_unpack_first(rotations) if rotations.shape[1] == 3 else _unpack_smallest(rotations),
        scales=unpack_scales(streams["scales"]),
        opacities=opacities.clip(-_FULL, _FULL).astype(np.float32),
        sh0=((streams["colors"] - 127.5) / _COLOR).astype(np.float32),
        shN=np.asarray((sh.astype(np.float32) - 128) / 128, np.float32),
    )


def _to_bytes(values: NDArray[np.floating]) -> Bytes:
    return np.asarray(np.rint(values).clip(0, 255), np.uint8)


def _pack_rotations(quats: Floats) -> Bytes:
    """(N, 4) of quaternions (N, 4) w x y z: the index of the largest of x y z w, then the others in order."""
    q = quats[:, [1, 2, 3, 0]].astype(np.float64)
    largest = np.abs(q).argmax(axis=1)
    q /= np.linalg.norm(q, axis=1, keepdims=True)
    negative = (q < 0) ^ (np.take_along_axis(q, largest[:, None], 1) < 0)
    magnitudes = np.rint(np.abs(q) * _MAGNITUDE).clip(0, 511).astype(np.uint32)
    packed = packed_but_largest(magnitudes | negative.astype(np.uint32) << 9, largest)
    return np.asarray(packed, "<u4").view(np.uint8).reshape(-1, 4)


def _unpack_smallest(packed: Bytes) -> Floats:
    """(N, 4) w x y z of what `_pack_rotations` gives."""
    words = np.ascontiguousarray(packed).view("<u4")
    codes = words >> np.array([20, 10, 0], np.uint32)
    others = np.where(codes & 512, -1.0, 1.0) * (codes & 511) / _MAGNITUDE
    return np.asarray(quaternions(others, words[:, 0] >> 30)[:, [3, 0, 1, 2]], np.float32)


def _unpack_first(packed: Bytes) -> Floats:
    """(N, 4) w x y z of (N, 3), x y z, as version 2 has them: w is not negative."""
    xyz = packed / 127.5 - 1
    w = np.sqrt(np.maximum(0, 1 - (xyz * xyz).sum(axis=1, keepdims=True)))
    quats = np.concatenate([w, xyz], axis=1)
    return np.asarray(quats / np.linalg.norm(quats, axis=1, keepdims=True), np.float32)
