"""Tiny ONNX networks whose answer is known: they compute depth from the colour of each pixel."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import yaml
from numpy.typing import NDArray
from onnx import TensorProto, helper

FLOAT = TensorProto.FLOAT


def save(
    folder: Path,
    nodes: Sequence[onnx.NodeProto],
    outputs: Sequence[str],
    manifest: Mapping[str, Any],
    *,
    shape: Sequence[int | str],
    constants: Mapping[str, NDArray[Any]] | None = None,
    dtype: int = FLOAT,
) -> Path:
    """Writes a network from "image" of `shape` to `outputs`, and its manifest; returns the ONNX file."""
    graph = helper.make_graph(
        list(nodes),
        "tiny",
        [helper.make_tensor_value_info("image", dtype, shape)],
        [helper.make_tensor_value_info(output, dtype, None) for output in outputs],
        [onnx.numpy_helper.from_array(value, key) for key, value in (constants or {}).items()],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=9)
    path = folder / "net.onnx"
    onnx.save(model, path)
    path.with_suffix(".yaml").write_text(yaml.safe_dump(dict(manifest)))
    return path


def given(height: int = 16, **changes: Any) -> dict[str, Any]:
    """The input of a manifest: RGB / 255, NCHW."""
    size = {"width": 2 * height + 2 * changes.get("wrap", 0), "height": height}
    return {"name": "image", **size, "layout": "NCHW", "channels": "RGB", "divisor": 255} | changes


def channel(index: int, target: str, *, axis: int = 1) -> onnx.NodeProto:
    """A node that takes one channel of "image", keeping the axis. Needs CHANNELS as constants."""
    return helper.make_node("Gather", ["image", f"index{index}"], [target], axis=axis)


CHANNELS = {f"index{index}": np.array([index], np.int64) for index in range(3)}


def red_depth(folder: Path, manifest: Mapping[str, Any], *, batch: int | str = "N", axis: int = 1) -> Path:
    """A network whose outputs depth, sky and sure are the first, second and third channel that it sees."""
    outputs, put = ["depth", "sky", "sure"], manifest["input"]
    nodes = [channel(index, output, axis=axis) for index, output in enumerate(outputs)]
    size = [3, put["height"], put["width"]] if axis == 1 else [put["height"], put["width"], 3]
    return save(folder, nodes, outputs, manifest, shape=[batch, *size], constants=CHANNELS)
