"""Random numbers that depend on what they are for and on nothing else."""

import hashlib

import numpy as np


def generator(seed: int, task: str, what: str, number: int) -> np.random.Generator:
    """Random numbers for one purpose at one time: the same for the same arguments, on every machine."""
    digest = hashlib.sha256(f"{seed}/{task}/{what}/{number}".encode()).digest()
    return np.random.default_rng(int.from_bytes(digest[:16], "little"))
