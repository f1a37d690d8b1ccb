"""Streamed SOG, version 1: a folder of which a viewer loads the leaves that it sees, as fine as needed.

Facts from https://developer.playcanvas.com/user-manual/gaussian-splatting/formats/streamed-sog: lod-meta.json
has a tree of boxes, and for each leaf and level of detail where its Gaussians are: a row of files that are
SOG folders, `LEVEL_NUMBER/`, an offset and a count. `env/` has what is always shown: the sky.
"""

from concurrent.futures import Executor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypedDict

import numpy as np
from scipy.spatial.transform import Rotation

from panolog.export.detail import MOST, SIDE, Corners, Detail, Node, around
from panolog.export.sog.whole_folder import GENERATOR, INDEX, META, new_folder, save
from panolog.export.sog.write import encode, json_bytes, numbers, threads
from panolog.export.splats import InMemory, Splats, SplatSource
from panolog.scene.errors import FormatError
from panolog.scene.files import StrPath

_SKY = "env"
_LEAST = 128 * 1024  # Gaussians of a file of a coarse level, at most: fewer are read before something is seen


class _Place(TypedDict):
    """Where the Gaussians of a leaf and level are."""

    file: int
    offset: int
    count: int


@dataclass(eq=False)
class _Chunks:
    """The files of all levels, each written when it is full."""

    folder: Path
    pool: Executor
    most: int  # Gaussians of a file of level 0
    names: list[str] = field(default_factory=list)
    counts: list[int] = field(default_factory=list)  # Gaussians by level
    _open: dict[int, tuple[int, list[Splats]]] = field(default_factory=dict)  # level -> its file and parts
    _files: list[int] = field(default_factory=list)  # by level, how many there are

    def add(self, level: int, splats: Splats) -> _Place:
        """Puts the Gaussians of a leaf into the file of a level, in their order. Raises OSError."""
        while len(self.counts) <= level:
            self.counts.append(0)
            self._files.append(0)
        parts = self._open.get(level, (0, []))[1]
        if parts and sum(map(len, parts)) + len(splats) > max(self.most >> level, min(self.most, _LEAST)):
            self._close(level)
        if level not in self._open:
            self._open[level] = (len(self.names), [])
            self.names.append(f"{level}_{self._files[level]}")
            self._files[level] += 1
        file, parts = self._open[level]
        place = _Place(file=file, offset=sum(map(len, parts)), count=len(splats))
        parts.append(splats)
        self.counts[level] += len(splats)
        return place

    def finish(self) -> None:
        """Writes what is not written yet. Raises OSError."""
        for level in sorted(self._open):
            self._close(level)

    def _close(self, level: int) -> None:
        file, parts = self._open.pop(level)
        whole = InMemory(Splats.joined(parts))
        parts.clear()
        save(self.folder / self.names[file], encode(whole, self.pool, sort=False))


def write_streamed(
    folder: StrPath,
    source: SplatSource,
    sky: SplatSource | None = None,
    *,
    side: float = SIDE,
    most: int = MOST,
    levels: int | None = None,
) -> None:
    """Writes a model as a folder that streams; it appears whole, and replaces one that this function wrote.

    While it is written, a file without a name on the same disk takes 236 bytes of each Gaussian.

    Args:
        sky: what is always shown whole.
        side, most, levels: of leaves, as `Detail` has them.

    Raises FormatError: there are no Gaussians, too many of the sky, or something else is at `folder`;
    OSError: the folder cannot be written, or the disk is full.
    """
    if not source.count:
        raise FormatError("nothing is selected: a model that streams needs at least one Gaussian")
    with new_folder(Path(folder)) as temporary, threads() as pool:
        detail = Detail(source, temporary, side=side, most=most, levels=levels)
        chunks, boxes = _Chunks(temporary, pool, most), list[Corners]()
        places: list[dict[str, _Place]] = []
        for leaf in detail.leaves():
            shown = [(level, splats) for level, splats in enumerate(leaf) if len(splats)]
            places.append({str(level): chunks.add(level, splats) for level, splats in shown})
            boxes.append(around([bounds(splats) for _, splats in shown]))
        chunks.finish()
        meta: dict[str, Any] = {
            "version": 1,
            "asset": {"generator": GENERATOR},
            "count": sum(chunks.counts),
            "counts": chunks.counts,
            "lodLevels": len(chunks.counts),
        }
        if sky is not None and sky.count:
            save(temporary / _SKY, encode(sky, pool))
            meta["environment"] = f"{_SKY}/{META}"
        meta["filenames"] = [f"{name}/{META}" for name in chunks.names]
        meta["tree"] = _tree(detail.tree, boxes, places)[1]
        save(temporary, {INDEX: json_bytes(meta)})


def bounds(splats: Splats) -> Corners:
    """(lower, upper), each (3,), of boxes of one standard deviation around Gaussians, as viewers expect."""
    matrices = np.abs(Rotation.from_quat(splats.quats, scalar_first=True).as_matrix())
    reach = (matrices @ np.exp(splats.scales.astype(np.float64))[:, :, None])[:, :, 0]
    return (splats.means - reach).min(axis=0), (splats.means + reach).max(axis=0)


def _tree(
    node: Node, boxes: list[Corners], places: list[dict[str, _Place]]
) -> tuple[Corners, dict[str, Any]]:
    """The box of a node of the tree, and the node as the format has it."""
    if node.children is None:
        assert node.leaf is not None
        box, content = boxes[node.leaf], dict[str, Any](lods=places[node.leaf])
    else:
        inner, children = zip(*(_tree(child, boxes, places) for child in node.children), strict=True)
        box, content = around(inner), {"children": list(children)}
    lower, upper = (numbers(side.astype(np.float32)) for side in box)
    return box, {"bound": {"min": lower, "max": upper}, **content}
