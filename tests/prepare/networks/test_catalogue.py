"""The list of networks, and the check of a user's file with a trial."""

import re
from pathlib import Path
from typing import Any

import pytest
import yaml
from onnx import helper

from panolog.prepare.networks import catalogue
from panolog.prepare.networks.catalogue import Known, known_networks
from panolog.prepare.networks.manifest import MaskManifest, read_manifest
from panolog.scene.files import sha256
from tests.orchestrator.cli.program import call, one_line, shown
from tests.prepare.networks.networks import CHANNELS, channel, given, red_depth, save

HEIGHT = 32
DEPTH = {
    "task": "depth",
    "input": given(HEIGHT),
    "depth": {"output": "depth", "kind": "inverse", "distance": "radial"},
}


@pytest.fixture(autouse=True)
def small_town(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(catalogue, "_TOWN", 64)


def reds(folder: Path, threshold: float = 0.9) -> Path:
    """A network of views that masks what is red."""
    manifest = {
        "task": "mask",
        "input": given(HEIGHT, width=HEIGHT, seam="tiles", fov=90),
        "ignore": {"output": "red", "threshold": threshold, "above": "ignore"},
    }
    shape: list[int | str] = ["N", 3, HEIGHT, HEIGHT]
    return save(folder, [channel(0, "red")], ["red"], manifest, shape=shape, constants=CHANNELS)


def test_each_network_of_the_list_has_a_licence_a_page_and_a_manifest_that_is_valid(tmp_path: Path) -> None:
    listed = shown("models")["networks"]
    assert len({entry["name"] for entry in listed}) == len(listed) >= 4
    for entry in listed:
        assert entry["licence"] and entry["page"].startswith("https://")
        assert entry["sha256"] is None or re.fullmatch("[0-9a-f]{64}", entry["sha256"])
        if entry["manifest"] is not None:
            path = tmp_path / "m.yaml"
            path.write_text(yaml.safe_dump(entry["manifest"]))
            assert read_manifest(path, MaskManifest).head
    text = call("models").stdout
    assert "SHA-256   not published" in text and "downloads none of them" in text


@pytest.mark.parametrize("task", ["mask", "depth"])
def test_a_users_file_is_tried(task: str, tmp_path: Path) -> None:
    model = reds(tmp_path) if task == "mask" else red_depth(tmp_path, DEPTH)
    checked = shown("models", model, "--width", 256)
    assert checked["sha256"] == sha256(model).hex()
    assert (checked["task"], checked["known"], checked["device"], checked["width"]) == (
        task,
        None,
        "cpu",
        256,
    )
    assert checked["inputs"][0].startswith("image (tensor(float) N x 3 x 32 x ")
    assert len(checked["outputs"]) == (1 if task == "mask" else 3)
    assert 0 < checked["seconds"] < 60 and checked["memory"] > 10e6
    assert checked["share"] < 0.3 if task == "mask" else checked["share"] > 0.9


def test_a_file_of_the_list_gets_its_manifest_and_keeps_the_users(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    model = reds(tmp_path)
    path = model.with_suffix(".yaml")
    manifest: dict[str, Any] = yaml.safe_load(path.read_text())
    path.unlink()
    listed = known_networks()[0].model_dump()
    entry = Known(**listed | {"name": "reds", "sha256": sha256(model).hex(), "manifest": manifest})
    monkeypatch.setattr(catalogue, "known_networks", lambda: (*known_networks(), entry))
    first = call("models", model, "--width", 128)
    assert first.exit_code == 0, first.output
    assert "net.yaml: written, as the SHA-256 is that of reds" in first.stderr
    assert "reds of the list" in first.stdout and "used by --mask-model" in first.stdout
    assert yaml.safe_load(path.read_text()) == manifest
    path.write_text(yaml.safe_dump(manifest | {"task": "sound"}))
    assert "net.yaml: task: must be mask or depth" in one_line(call("models", model))


def test_what_cannot_be_used_is_one_line(tmp_path: Path) -> None:
    assert "there is no such model" in one_line(call("models", tmp_path / "no.onnx"))
    model = reds(tmp_path, threshold=-1.0)
    assert "masks all of a town without people" in one_line(call("models", model, "--width", 128))
    model.with_suffix(".yaml").unlink()
    line = one_line(call("models", model))
    assert "there is no manifest net.yaml next to it" in line
    assert "inputs image (tensor(float) N x 3 x 32 x 32); outputs red (" in line
    model.write_bytes(b"no network")
    assert "onnxruntime cannot open it" in one_line(call("models", model))


def test_a_network_that_fails_or_finds_no_depth_cannot_be_used(tmp_path: Path) -> None:
    nothing = dict(DEPTH) | {"sky": {"output": "sky", "threshold": -1.0, "above": "sky"}}
    model = red_depth(tmp_path, nothing)
    assert "finds no depth in a town" in one_line(call("models", model, "--width", 128))
    short = helper.make_node("Slice", ["image", "index0", "index1", "index2"], ["red"])
    manifest = {"task": "mask", "input": given(HEIGHT)} | {
        "ignore": {"output": "red", "threshold": 0.9, "above": "ignore"}
    }
    model = save(tmp_path, [short], ["red"], manifest, shape=["N", 3, HEIGHT, 2 * HEIGHT], constants=CHANNELS)
    assert "net.onnx: " in one_line(call("models", model, "--width", 128))
