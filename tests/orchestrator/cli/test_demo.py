"""`panolog demo`: what it makes, where, and where it cannot go. Nothing is made or trained here."""

from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import pytest

from panolog.orchestrator.cli.commands.demo import SETTINGS
from panolog.orchestrator.runs.config import load_config
from panolog.workers.training.schedule import Schedule
from tests.orchestrator.cli.program import call, one_line
from tests.orchestrator.history import begun


class Demo(NamedTuple):
    """What the command would have made and started."""

    made: list[tuple[Any, ...]]  # what, where, with which options
    started: list[tuple[Path, Path, str]]  # scene, run, recipe and blocks


@pytest.fixture
def demo(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Demo:
    found = Demo([], [])

    def make(kind: str, folder: Path, **options: Any) -> None:
        found.made.append((kind, folder, options.get("panoramas"), options.get("flight")))

    def start(scene: Path, root: Path, config: Any, *_: object) -> None:
        found.started.append((scene, root, f"{config.recipe} {config.blocks}"))

    for kind in ("town", "flight", "city"):
        monkeypatch.setattr(f"panolog.orchestrator.cli.commands.demo.make_{kind}", partial(make, kind))
    monkeypatch.setattr("panolog.orchestrator.cli.session.session.start", start)
    monkeypatch.setattr("panolog.orchestrator.cli.run.say_results", lambda *_: None)
    monkeypatch.chdir(tmp_path)
    return found


def test_where_a_demo_cannot_go(demo: Demo, tmp_path: Path) -> None:
    (tmp_path / "thesis.txt").touch()
    assert "is not empty" in one_line(call("demo", "-o", "."))
    assert "cannot be written next to it" in one_line(call("demo", "-o", "/"))
    begun(tmp_path / "run", scene=tmp_path / "run-town")
    for options in (("--flight",), ("--city", "9")):
        assert "a run of another scene" in one_line(call("demo", *options, "-o", tmp_path / "run"))
    assert call("demo", "--city", "1").exit_code == 2
    assert demo == ([], [])
    assert {path.name for path in tmp_path.iterdir()} == {"thesis.txt", "run"}


def test_a_town_whose_making_was_cut_off_is_made_again(demo: Demo, tmp_path: Path) -> None:
    model = tmp_path / "run-town" / "sparse" / "0"
    model.mkdir(parents=True)
    (model / "cameras.bin").touch()
    assert call("demo", "-o", tmp_path / "run").exit_code == 0
    (model / "points3D.bin").touch()
    assert call("demo", "-o", tmp_path / "run").exit_code == 0
    assert demo.made == [("town", tmp_path / "run-town", None, None)]
    assert len(demo.started) == 2


def test_each_place_is_made_next_to_its_run(demo: Demo, tmp_path: Path) -> None:
    for options in (("--flight",), ("--city", "300"), ("--city", "20", "--flight")):
        assert call("demo", *options).exit_code == 0
    flight, city, seen = (tmp_path / "runs" / f"{name}" for name in SCENES)
    assert demo.made == [("flight", flight, 32, None), ("city", city, 300, False), ("city", seen, 20, True)]
    assert [scene for scene, *_ in demo.started] == [flight, city, seen]
    assert demo.started[0][1] == Path("runs/flight")
    assert [settings for *_, settings in demo.started] == ["paper 2x1x1", "panolog 7", "panolog 2"]


SCENES = ("flight-district", "city-city-300", "city-city-20-flight")


@pytest.mark.parametrize("refine", [False, True])
def test_the_demo_goes_through_what_the_paper_describes(refine: bool) -> None:
    """Growth of harmonics, densification before and after an opacity reset (app. D), and a quiet end."""
    config = load_config(flags=SETTINGS)
    schedule = Schedule(config, config.iterations, 1.0, refine)
    every = range(1, config.iterations + 1)
    (reset,) = [i for i in every if schedule.resets(i)]
    densified = [i for i in every if schedule.densifies(i)]
    assert densified[0] < reset < densified[-1] < 0.7 * config.iterations
    degrees = {schedule.sh_degree(i) for i in every}
    assert degrees == ({3} if refine else {0, 1, 2, 3})
