"""What a manifest may say, and one clear line for everything else, whatever the bytes."""

import json
import re
import textwrap
from pathlib import Path
from typing import Any

import pytest
import yaml
from hypothesis import example, given, settings
from hypothesis import strategies as st

from panolog.prepare.networks.manifest import (
    MAX_BYTES,
    DepthManifest,
    MaskManifest,
    manifest_path,
    read_manifest,
)
from panolog.scene.errors import InputError

INPUT = {"name": "x", "width": 64, "height": 32, "layout": "NCHW", "channels": "RGB", "divisor": 255}
DEPTH = {"output": "d", "kind": "depth", "distance": "radial"}
WHOLE: dict[str, Any] = {
    "task": "depth",
    "input": INPUT
    | {"mean": [0.5, 0.4, 0.3], "std": [0.2, 0.2, 0.2], "seam": "wrap", "wrap": 4, "width": 72},
    "depth": DEPTH | {"factor": 100},
    "sky": {"output": "s", "threshold": 0.5, "above": "sky"},
    "confidence": {"output": "c", "threshold": 0.1, "above": "sure"},
}


def write(path: Path, tree: object) -> Path:
    path.write_text(json.dumps(tree) if path.suffix == ".json" else yaml.safe_dump(tree))
    return path


@pytest.mark.parametrize("suffix", ["yaml", "json"])
def test_all_that_can_be_said(tmp_path: Path, suffix: str) -> None:
    manifest = read_manifest(write(tmp_path / f"m.{suffix}", WHOLE), DepthManifest)
    assert manifest.input.wrap == 4 and manifest.input.mean == (0.5, 0.4, 0.3)
    assert manifest.confidence is not None and manifest.confidence.above == "sure"


def changed(path: str, value: object) -> dict[str, Any]:
    """WHOLE with one field changed, or removed where the value is None."""
    tree = json.loads(json.dumps(WHOLE))
    *groups, name = path.split(".")
    target = tree
    for group in groups:
        target = target[group]
    if value is None:
        del target[name]
    else:
        target[name] = value
    return tree  # type: ignore[no-any-return]


@pytest.mark.parametrize(
    "path, value, message",
    [
        ("task", "mask", "task: it must be 'depth'"),
        ("input", None, "input: it is missing"),
        ("input.width", 65, r"input: width must be 2 \* height \+ 2 \* wrap = 72, not 65"),
        ("input.height", 10**9, "input.height: it must be at most"),
        ("input.seam", "turn", "input: wrap is the number of repeated columns"),
        ("input.divisor", 0, "input.divisor: it must be above 0"),
        ("input.std", [1, 0, 1], "input.std.1: it must be above 0"),
        ("depth.factor", float("inf"), "depth.factor: a finite number is needed"),
        ("depth.scale", 3, "there is no field depth.scale"),
        ("skies", {}, "there is no field skies"),
    ],
)
def test_what_is_wrong_is_named(tmp_path: Path, path: str, value: object, message: str) -> None:
    file = write(tmp_path / "m.yaml", changed(path, value))
    with pytest.raises(InputError, match=rf"m\.yaml: {message}") as error:
        read_manifest(file, DepthManifest)
    assert "\n" not in str(error.value)


def test_a_mask_manifest_has_one_head(tmp_path: Path) -> None:
    classes = {"output": "c", "ignore": [1, 2]}
    threshold = {"output": "c", "threshold": 0.5, "above": "ignore"}
    for heads in ({}, {"classes": classes, "ignore": threshold}):
        with pytest.raises(InputError, match="manifest: give either classes or ignore"):
            read_manifest(write(tmp_path / "m.yaml", {"task": "mask", "input": INPUT, **heads}), MaskManifest)
    found = read_manifest(
        write(tmp_path / "m.yaml", {"task": "mask", "input": INPUT, "classes": classes}), MaskManifest
    )
    assert found.head == found.classes


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"seam": "tiles", "width": 32}, "input: fov is the angle of a view in degrees"),
        ({"fov": 90}, "input: fov is the angle of a view in degrees"),
        ({"seam": "tiles", "fov": 90}, "input: with seam: tiles, width must be height = 32, not 64"),
        ({"seam": "tiles", "fov": 20, "width": 32}, "input.fov: it must be at least 40"),
        (
            {"seam": "tiles", "fov": 90, "width": 4096, "height": 4096},
            "12868 columns, more than 8192; raise",
        ),
    ],
)
def test_views_are_square_and_have_an_angle(tmp_path: Path, changes: dict[str, Any], message: str) -> None:
    classes = {"output": "c", "ignore": [1]}
    tree = {"task": "mask", "input": INPUT | changes, "classes": classes}
    with pytest.raises(InputError, match=message):
        read_manifest(write(tmp_path / "m.yaml", tree), MaskManifest)


def test_depth_is_not_estimated_of_views(tmp_path: Path) -> None:
    tree = {"task": "depth", "input": INPUT | {"seam": "tiles", "width": 32, "fov": 90}, "depth": DEPTH}
    with pytest.raises(InputError, match="manifest: seam: tiles is for masks"):
        read_manifest(write(tmp_path / "m.yaml", tree), DepthManifest)


def test_the_manifest_lies_beside_the_model(tmp_path: Path) -> None:
    model = tmp_path / "M.onnx"
    with pytest.raises(InputError, match=r"M\.onnx: there is no such model"):
        manifest_path(model)
    model.touch()
    with pytest.raises(InputError, match=r"M\.onnx: there is no manifest M\.yaml next to it"):
        manifest_path(model)
    (tmp_path / "M.json").touch()
    assert manifest_path(model) == tmp_path / "M.json"


BOMB = "a: &a [x,x,x,x,x,x,x,x]\n" + "".join(
    f"{chr(98 + i)}: &{chr(98 + i)} [{','.join(['*' + chr(97 + i)] * 8)}]\n" for i in range(12)
)


@pytest.mark.parametrize(
    "data, message",
    [
        (b"", "manifest: keys with values are needed"),
        (b"\xff\xfe\x00", "cannot be read"),
        (b"a: [", "cannot be read"),
        (BOMB.encode(), "neither YAML aliases"),
        (b"[" * 60_000, "nor more than 8 levels"),
        (b"x" * (MAX_BYTES + 1), "so it is not a manifest"),
        (b"task: !!python/object/apply:os.system [ls]", "cannot be read"),
    ],
)
@pytest.mark.parametrize("suffix", ["yaml", "json"])
def test_hostile_bytes(tmp_path: Path, data: bytes, message: str, suffix: str) -> None:
    file = tmp_path / f"m.{suffix}"
    file.write_bytes(data)
    with pytest.raises(InputError, match=message if suffix == "yaml" else r"m\.json: ") as error:
        read_manifest(file, DepthManifest)
    assert "\n" not in str(error.value)


@settings(max_examples=200)
@example(b"2020-99-99", 0)
@given(st.binary(max_size=8), st.integers(0, 600))
def test_mutated_bytes(tmp_path_factory: pytest.TempPathFactory, noise: bytes, at: int) -> None:
    file = tmp_path_factory.getbasetemp() / "mutated.yaml"
    data = yaml.safe_dump(WHOLE).encode()
    file.write_bytes(data[:at] + noise + data[at + len(noise) :])
    try:
        read_manifest(file, DepthManifest)
    except InputError as error:
        assert "mutated.yaml: " in str(error) and "\n" not in str(error)


def test_the_manifests_on_the_page_are_valid(tmp_path: Path) -> None:
    page = (Path(__file__).resolve().parents[3] / "docs" / "depth-and-masks.md").read_text()
    blocks = [textwrap.dedent(block) for block in re.findall(r"(?:^ {4,}.*\n)+", page, re.MULTILINE)]
    file = tmp_path / "m.yaml"
    (depth,) = [block for block in blocks if block.startswith("task: depth")]
    file.write_text(depth)
    manifest = read_manifest(file, DepthManifest)
    assert manifest.sky is not None and manifest.confidence is not None
    heads = [block for block in blocks if block.startswith(("classes:", "ignore:"))]
    assert len(heads) == 2
    for head in heads:
        file.write_text(yaml.safe_dump({"task": "mask", "input": INPUT, **yaml.safe_load(head)}))
        read_manifest(file, MaskManifest)
