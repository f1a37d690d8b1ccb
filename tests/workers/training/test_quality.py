import json
import subprocess
from pathlib import Path

import pytest

from tests.ray_head import BIN

pytestmark = [pytest.mark.system, pytest.mark.nightly]


def test_the_demo_does_not_lose_quality(tmp_path: Path) -> None:
    """Its held-out quality once fell from 28.0 to 26.5 dB with a setting that was right for longer runs."""
    run = tmp_path / "run"
    subprocess.run([BIN / "panolog", "demo", "-o", run], check=True)
    mean = json.loads((run / "eval" / "metrics.json").read_text())["mean"]
    assert mean["psnr"] > 27.4
    assert mean["ws_psnr"] > 27.0
