"""The manifest of DAP, and its export on a stand-in for the published code: same interface, tiny weights."""

import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from panolog.prepare.networks.depth_maps import make_depth, plan_depth
from panolog.prepare.networks.inverse_depth import FULL, NEAREST
from panolog.prepare.panorama_files import list_posed_panoramas
from tests.scenes import write_scene

pytestmark = pytest.mark.system

DAP = Path(__file__).resolve().parents[3] / "docs" / "dap"
CODE = """
import torch
from torch import nn


class Tiny(nn.Module):
    def __init__(self):
        super().__init__()
        self.weight = nn.Parameter(torch.zeros(1))

    def forward(self, image):
        depth = image[:, :1] * self.weight
        depth[depth < 0] = 0
        return {"pred_depth": depth, "pred_mask": image[:, 1:2]}


def make(model):
    assert model == {"name": "dap"}
    return Tiny()
"""


@pytest.fixture
def code(tmp_path: Path) -> Path:
    root = tmp_path / "DAP"
    (root / "networks").mkdir(parents=True)
    (root / "networks" / "models.py").write_text(CODE)
    (root / "config").mkdir()
    (root / "config" / "infer.yaml").write_text("model: {name: dap}\n")
    torch.save({"module.weight": torch.tensor([0.5])}, tmp_path / "model.pth")
    return root


def export(code: Path, *more: str) -> subprocess.CompletedProcess[str]:
    script = [sys.executable, "-W", "ignore", str(DAP / "export_onnx.py"), "--code", str(code)]
    rest = ["--weights", str(code.parent / "model.pth"), "--output", str(code.parent / "DAP.onnx"), *more]
    return subprocess.run(script + rest, check=False, capture_output=True, text=True, cwd=code.parent)


def test_the_exported_network_gives_maps(code: Path) -> None:
    ended = export(code, "--compare")
    assert ended.returncode == 0, ended.stderr
    assert "largest difference to the network itself: 0" in ended.stdout
    (code.parent / "DAP.yaml").write_text((DAP / "DAP.yaml").read_text())
    scene = write_scene(code.parent / "scene", names=["a.png", "b.png"])
    image = np.zeros((512, 1024, 3), np.uint8)
    image[..., 2], image[:100, :, 1] = 200, 255  # red is depth, green sky
    for name in ("a.png", "b.png"):
        cv2.imwrite(str(scene / "images" / name), image)
    make_depth(plan_depth(list_posed_panoramas(scene), code.parent / "DAP.onnx"))
    depth = cv2.imread(str(scene / "depths" / "a.png"), cv2.IMREAD_UNCHANGED)
    assert depth is not None
    metres = 100 * 0.5 * 200 / 255
    assert (depth[:100] == 0).all()
    assert np.unique(depth[100:]) == pytest.approx(FULL * NEAREST / metres, abs=1)


def test_weights_of_something_else_are_refused(code: Path) -> None:
    torch.save({"other": torch.tensor([0.5])}, code.parent / "model.pth")
    ended = export(code)
    assert ended.returncode == 1
    assert "1 weights are missing, such as weight" in ended.stderr
    assert not (code.parent / "DAP.onnx").exists()
