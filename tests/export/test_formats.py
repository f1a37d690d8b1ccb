"""What holds for every format: equal models are equal bytes, and damage is one line or other Gaussians."""

from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from panolog.export.compressed_ply import write_compressed_ply
from panolog.export.earth import enu_to_ecef
from panolog.export.gltf.glb import write_glb
from panolog.export.gltf.tiles import write_tiles
from panolog.export.reading import read_model
from panolog.export.sog.streamed import write_streamed
from panolog.export.sog.write import write_sog
from panolog.export.splats import InMemory
from panolog.export.spz import write_spz
from panolog.scene.errors import FormatError
from tests.data import mutated
from tests.export.gaussians import line_of, scattered
from tests.export.sog.models import write_unpacked

MORE_THAN_A_PIECE = 70_000
PLACE = enu_to_ecef(48, 11, 500)
READABLE: dict[str, tuple[Callable[[Path, InMemory], object], int]] = {  # with a number of Gaussians
    "SPZ 3": (partial(write_spz, version=3), MORE_THAN_A_PIECE),
    "SPZ 4": (partial(write_spz, version=4), MORE_THAN_A_PIECE),
    "compressed PLY": (write_compressed_ply, MORE_THAN_A_PIECE),
    "SOG": (write_sog, 1000),
    "SOG as a folder": (write_unpacked, 1000),
}
WRITERS = {name: writer for name, writer in READABLE.items() if name != "SOG as a folder"} | {
    "GLB": (write_glb, 1000),
    "3D Tiles": (partial(write_tiles, to_ecef=PLACE, side=30, levels=3), 3000),
    "streamed": (partial(write_streamed, side=30, most=800, levels=2), 3000),
}


def files_of(path: Path) -> list[Path]:
    return [path] if path.is_file() else sorted(file for file in path.rglob("*") if file.is_file())


def contents(path: Path) -> dict[str, bytes]:
    return {file.relative_to(path).as_posix(): file.read_bytes() for file in files_of(path)}


@pytest.mark.parametrize("name", WRITERS)
def test_equal_models_are_equal_bytes_and_nothing_is_refused(tmp_path: Path, name: str) -> None:
    write, count = WRITERS[name]
    for file in "ab":
        write(tmp_path / file, InMemory(scattered(count, 1)))
    assert contents(tmp_path / "a") == contents(tmp_path / "b")
    assert name not in READABLE or len(read_model(tmp_path / "a")) == count
    with pytest.raises(FormatError, match=r"no Gaussian|nothing is selected"):
        write(tmp_path / "c", InMemory(scattered(0)))
    assert {path.name for path in tmp_path.iterdir()} == {"a", "b"}


@pytest.mark.parametrize("mutations", [40, pytest.param(400, marks=pytest.mark.nightly)])
@pytest.mark.parametrize("name", READABLE)
def test_damage_is_one_line_or_other_gaussians(tmp_path: Path, name: str, mutations: int) -> None:
    path, rng, found = tmp_path / "a", np.random.default_rng(0), 0
    READABLE[name][0](path, InMemory(scattered(300, 1)))
    files = files_of(path)
    for number in range(mutations):
        file = files[number % len(files)]
        whole = file.read_bytes()
        kept = number % 2 * max(0, len(whole) - 600)  # the directory of an archive decides most
        file.write_bytes(whole[:kept] + mutated(whole[kept:], rng))
        found += line_of(path) != ""
        file.write_bytes(whole)
    assert found > mutations / 10
    if len(files) == 1:
        for length in range(0, len(whole), len(whole) // 20):
            path.write_bytes(whole[:length])
            assert line_of(path)
