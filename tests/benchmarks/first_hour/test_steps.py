"""The steps themselves on the CPU, and what only a card can show with a stand-in for it."""

import json
from pathlib import Path

import pytest
import torch

from benchmarks.first_hour import __main__ as program
from benchmarks.first_hour import quality
from benchmarks.first_hour.quality import Result


@pytest.mark.parametrize(("on_card", "ending"), [(21.5, "passed"), (20.9, "failed")])
def test_a_card_that_reconstructs_worse_fails(on_card: float, ending: str) -> None:
    results = [
        Result(device, psnr, 0.8, psnr, 900, 30.0) for device, psnr in (("cuda", on_card), ("cpu", 22.0))
    ]
    outcome = quality.outcome_of(results, "")
    assert outcome.ending == ending
    assert outcome.figure == f"PSNR {on_card:.2f} dB on cuda, 22.00 dB on cpu"


@pytest.mark.nightly
def test_a_rehearsal(tmp_path: Path) -> None:
    """In real processes, on the CPU; without a card a run on one says so in every step."""
    folder = tmp_path / "cpu"
    steps = "machine,memcheck,waits,memory,demo,scene,gsplat"
    assert program.main(["-o", str(folder), "--device", "cpu", "--only", steps]) == 0
    page = (folder / "first-hour.md").read_text()
    results = json.loads((folder / "first-hour.json").read_bytes())["steps"]
    passed = {name for name, step in results.items() if step["ending"] == "passed"}
    assert passed == {"machine", "waits", "memory", "demo"}
    assert "| PanoLOG " in page and "ms an iteration" in page
    if not torch.cuda.is_available():
        assert program.main(["-o", str(tmp_path / "cuda"), "--only", "machine,demo"]) == 1
        page = (tmp_path / "cuda" / "first-hour.md").read_text()
        assert "finds no card" in page and "| demo    | skipped    |" in page
