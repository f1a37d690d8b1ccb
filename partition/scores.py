"""Gradient scores (eq. 10) in a file of their own, sparse: they are 0 where a camera does not see a block.

The file is what `scipy.sparse.load_npz` reads, with one more array, `cameras`.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import BinaryIO
from zipfile import BadZipFile

import numpy as np
import scipy
from numpy.typing import ArrayLike

from panolog.scene.errors import InputError
from panolog.scene.files import atomic


def write_scores(path: Path, cameras: Sequence[int], scores: "ArrayLike | scipy.sparse.csr_array") -> None:
    """Writes the scores (K, B) of cameras, which are K rows of Scene.panoramas."""
    values = scipy.sparse.csr_array(scores, dtype=np.float64)
    with atomic(path) as temporary, temporary.open("wb") as file:
        np.savez(
            file,
            cameras=np.array(cameras, np.int64),
            format=np.array(b"csr"),
            shape=np.array(values.shape),
            data=values.data,
            indices=values.indices,
            indptr=values.indptr,
            _is_array=np.array(True),
        )


def read_scores(file: Path | BinaryIO, cameras: Sequence[int], blocks: int) -> "scipy.sparse.csr_array":
    """The scores (K, blocks) of these K rows of Scene.panoramas, also as earlier versions wrote them: dense.

    Raises InputError if they are of others or the file is damaged, OSError if it cannot be read.
    """
    try:
        with np.load(file, allow_pickle=False) as arrays:
            if not np.array_equal(arrays["cameras"], np.array(cameras, np.int64)):
                raise InputError(f"{_name(file)}: is of other cameras than the run")
            if "scores" in arrays:
                found = scipy.sparse.csr_array(arrays["scores"], dtype=np.float64)
            else:
                parts = arrays["data"].astype(np.float64), arrays["indices"], arrays["indptr"]
                found = scipy.sparse.csr_array(parts, shape=(len(cameras), blocks))
                found.check_format(full_check=True)  # an index outside would be followed
    except (BadZipFile, EOFError, KeyError, TypeError, ValueError) as error:
        raise InputError(f"{_name(file)}: holds no gradient scores: {error}") from error
    if found.shape != (len(cameras), blocks):
        raise InputError(f"{_name(file)}: is of other blocks than the run")
    return found


def _name(file: Path | BinaryIO) -> str:
    return str(file) if isinstance(file, Path) else "scores.npz"
