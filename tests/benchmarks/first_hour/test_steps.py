"""The steps themselves on the CPU, and what only a card can show with a stand-in for it."""

import json
import warnings
from collections import Counter
from pathlib import Path

import pytest
import torch

from benchmarks import runs
from benchmarks.first_hour import __main__ as program
from benchmarks.first_hour import quality, waits
from benchmarks.first_hour.outcome import ROOT, Context
from benchmarks.first_hour.quality import Result


def test_waits_are_counted_by_place(monkeypatch: pytest.MonkeyPatch) -> None:
    modes: list[str] = []
    monkeypatch.setattr(torch.cuda, "set_sync_debug_mode", modes.append)
    found: Counter[str] = Counter()
    with waits.counted(found):
        for _ in range(3):
            warnings.warn_explicit(
                "called a synchronizing CUDA operation", UserWarning, str(ROOT / "workers/merge.py"), 7
            )
        warnings.warn_explicit("something else", UserWarning, "other.py", 1)
    assert found == {"workers/merge.py:7": 3}
    assert modes == ["warn", "default"]


@pytest.mark.parametrize(("on_card", "ending"), [(21.5, "passed"), (20.9, "failed")])
def test_a_card_that_reconstructs_worse_fails(on_card: float, ending: str) -> None:
    results = [
        Result(device, psnr, 0.8, psnr, 900, 30.0) for device, psnr in (("cuda", on_card), ("cpu", 22.0))
    ]
    outcome = quality.outcome_of(results, ())
    assert outcome.ending == ending
    assert outcome.figure == f"PSNR {on_card:.2f} dB on cuda, 22.00 dB on cpu"


@pytest.mark.parametrize(("seconds", "devices"), [(300, ["cuda"]), (900, ["cuda", "cpu"])])
def test_a_scene_is_trained_on_the_cpu_only_if_there_is_time(
    seconds: float, devices: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    trained: list[str] = []

    def reconstruct(_context: Context, _place: Path, device: str, _settings: object) -> Result:
        trained.append(device)
        return Result(device, 22.0, 0.8, 21.0, 900, 30.0)

    estimated = json.dumps({"preflight": {"estimate": {"seconds": 500.0}}})
    monkeypatch.setattr(quality, "reconstruct", reconstruct)
    monkeypatch.setattr(runs, "panolog", lambda *_: estimated)
    (tmp_path / "scene").mkdir()
    outcome = quality.scene(Context("scene", str(tmp_path), "cuda", seconds, scene=str(tmp_path)))
    assert trained == devices
    assert outcome.ending == "passed"
    assert ("it needs about 500 s" in outcome.reason) == ("cpu" not in devices)


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
