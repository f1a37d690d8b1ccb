"""Layers tell who made them; whatever happens to their bytes, no reader crashes or takes too much."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from panolog.prepare.panorama_files import load_resized
from panolog.prepare.provenance import (
    Provenance,
    is_user_file,
    png_with_provenance,
    read_layer,
    read_provenance,
)
from panolog.scene.errors import InputError

KEY = "ab" * 32
LAYER = np.random.default_rng(0).integers(0, 256, (16, 32), np.uint8)


def test_only_a_damaged_layer_of_ours_is_not_the_users(tmp_path: Path) -> None:
    path = tmp_path / "a.png"
    assert read_provenance(path) is None and not is_user_file(path)
    path.write_bytes(b"PanoLOG")
    assert read_provenance(path) is None and is_user_file(path)
    path.write_bytes(png_with_provenance(LAYER, KEY)[:-50])
    assert read_provenance(path) == Provenance(KEY, "damaged") and not is_user_file(path)


@settings(max_examples=150)
@given(st.binary(min_size=1, max_size=6), st.integers(0, 900))
def test_mutated_layers(tmp_path_factory: pytest.TempPathFactory, noise: bytes, at: int) -> None:
    path = tmp_path_factory.getbasetemp() / "mutated.png"
    data = png_with_provenance(LAYER, KEY)
    path.write_bytes(data[:at] + noise + data[at + len(noise) :])
    read_provenance(path)
    for read in (lambda: read_layer(path), lambda: load_resized(path, 16)):
        try:
            assert read().size > 0
        except InputError as error:
            assert "mutated.png: " in str(error) and "\n" not in str(error)


@pytest.mark.parametrize("size", [(60_000, 30_000), (2**31 - 2, 2**30 - 1), (0, 0), (2**32 - 1, 1)])
def test_headers_that_promise_too_much(tmp_path: Path, size: tuple[int, int]) -> None:
    path = tmp_path / "bomb.png"
    data = png_with_provenance(LAYER, KEY)
    path.write_bytes(data[:16] + size[0].to_bytes(4, "big") + size[1].to_bytes(4, "big") + data[24:])
    for read in (lambda: read_layer(path), lambda: load_resized(path, 16)):
        with pytest.raises(InputError, match=r"bomb\.png: "):
            read()
    assert read_provenance(path) == Provenance(KEY, "damaged")


def test_a_chunk_that_promises_too_much_takes_no_memory(tmp_path: Path) -> None:
    path = tmp_path / "bomb.png"
    data = png_with_provenance(LAYER, KEY)
    path.write_bytes(data[:33] + (2**31 - 1).to_bytes(4, "big") + data[37:])
    code = "import sys; from pathlib import Path; from panolog.prepare.provenance import read_provenance\n"
    code += "assert read_provenance(Path(sys.argv[1])).state == 'damaged'\n"
    code += "print(Path('/proc/self/status').read_text().split('VmHWM:')[1].split()[0])"  # not its parent's
    done = subprocess.run([sys.executable, "-c", code, str(path)], check=True, capture_output=True, text=True)
    assert int(done.stdout) < 500_000  # KiB
