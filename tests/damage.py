"""Damaged files, for the tests that read them."""

import numpy as np


def mutated(data: bytes, rng: np.random.Generator) -> bytes:
    """A file in which bits flip, and which is cut, or where some bytes are overwritten or repeated."""
    changed = bytearray(data)
    for _ in range(rng.integers(1, 4)):
        at = int(rng.integers(len(changed)))
        match rng.integers(4):
            case 0:
                changed[at] ^= 1 << int(rng.integers(8))
            case 1:
                del changed[at + 1 :]
            case 2:
                changed[at : at + int(rng.integers(9))] = rng.bytes(int(rng.integers(9)))
            case _:
                changed[at:at] = changed[at : at + int(rng.integers(40))]
        if not changed:
            break
    return bytes(changed)
