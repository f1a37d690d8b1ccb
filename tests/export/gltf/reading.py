"""Reads GLBs as the specification says, for the tests; nothing of the writer is used."""

import json
import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Glb:
    """Both chunks of a file."""

    document: dict[str, Any]
    buffer: bytes

    @property
    def primitive(self) -> dict[str, Any]:
        """The only one."""
        (mesh,) = self.document["meshes"]
        (primitive,) = mesh["primitives"]
        return dict(primitive)

    @property
    def matrix(self) -> NDArray[np.float64]:
        """(4, 4) of the only node."""
        (node,) = self.document["nodes"]
        return np.array(node["matrix"]).reshape(4, 4).T

    def view(self, index: int) -> bytes:
        """The bytes of a buffer view."""
        view = self.document["bufferViews"][index]
        start = view.get("byteOffset", 0)
        return self.buffer[start : start + view["byteLength"]]


def read_glb(path: Path) -> Glb:
    """A GLB, whose structure is checked."""
    data = path.read_bytes()
    magic, version, size = struct.unpack_from("<4sII", data)
    assert (magic, version, size) == (b"glTF", 2, len(data))
    length, kind = struct.unpack_from("<I4s", data, 12)
    assert kind == b"JSON" and length % 4 == 0
    document = json.loads(data[20 : 20 + length])
    rest, kind = struct.unpack_from("<I4s", data, 20 + length)
    assert kind == b"BIN\0" and rest % 4 == 0 and 28 + length + rest == size
    buffer = data[28 + length :]
    assert 0 <= len(buffer) - document["buffers"][0]["byteLength"] < 4
    return Glb(document, buffer)
