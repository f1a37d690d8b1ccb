"""What commands say of a finished run of which files are lost or damaged."""

import re
from pathlib import Path
from shutil import copytree

import pytest

from panolog.orchestrator.cli.session import session
from panolog.orchestrator.runs.config import load_config
from panolog.orchestrator.runs.state import ignore
from tests.orchestrator.cli.program import call, one_line
from tests.orchestrator.cli.session.test_session import calibrating

pytestmark = pytest.mark.system


@pytest.fixture(scope="module")
def calm(scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished run."""
    root = tmp_path_factory.mktemp("runs") / "calm"
    config = load_config(flags={"width": 64, "iterations": 2, "blocks": "2x1x1", "sky.count": 2})
    session.start(scene, root, config, None, ignore, calibrating())
    return root


def damage(database: Path, how: str) -> None:
    if how == "missing":
        database.unlink()
    else:
        size = {"empty": 0, "truncated": 20_000}.get(how, database.stat().st_size)
        database.write_bytes(database.read_bytes()[:size] if how != "other" else b"no database" * 1000)


@pytest.mark.parametrize(
    ("how", "command"),
    [
        *[(how, "resume") for how in ("missing", "empty", "truncated", "other")],
        *[("missing", command) for command in ("status", "report", "clean")],
    ],
)
def test_a_run_without_its_database_is_left_as_it_is(
    how: str, command: str, calm: Path, tmp_path: Path
) -> None:
    """A finished run was trained again, over its files."""
    root = copytree(calm, tmp_path / "run")
    damage(root / "run.db", how)
    before = {path: path.stat().st_mtime_ns for path in root.rglob("*.*") if path.name != "run.db"}
    done = call(command, root)
    line = " ".join((done.stdout + done.stderr).split())
    assert done.exit_code == 2
    assert f"{root / 'run.db'}: " in line
    assert "put back a copy of it, or start a new run in another folder; `panolog export` works" in line
    assert {path: path.stat().st_mtime_ns for path in root.rglob("*.*") if path.name != "run.db"} == before


DAMAGED = [
    *[("report", f"{name}.json") for name in ("partition/plan", "eval/metrics", "eval/seams")],
    ("compare", "eval/metrics.json"),
    *[(command, "partition/plan.json") for command in ("view", "partition")],
    *[(command, "georef.json") for command in ("view", "export")],
]


@pytest.mark.parametrize("content", ["{", "[1]", "[" * 100_000], ids=["cut", "other", "deep"])
@pytest.mark.parametrize(("command", "name"), DAMAGED)
def test_a_damaged_file_of_a_run_is_named_with_its_folder(
    command: str, name: str, content: str, calm: Path, tmp_path: Path
) -> None:
    root = copytree(calm, tmp_path / "run")
    (root / name).write_text(content)
    output = ["-o", tmp_path / "made"] if command in ("view", "export") else []
    others = [calm] if command == "compare" else []
    line = one_line(call(command, root, *others, *output, *(["--glb"] if command == "export" else [])))
    assert f"{root / name}: " in line or f"{root / name} " in line
    assert re.search("measures it anew|measure it again|make the plan again|remove it|is not JSON", line)


def test_what_a_resume_of_a_finished_run_says_of_damaged_metrics(calm: Path, tmp_path: Path) -> None:
    root = copytree(calm, tmp_path / "run")
    (root / "eval" / "metrics.json").write_text("{")
    done = call("resume", root)
    assert f"{root / 'eval' / 'metrics.json'}: is damaged" in done.output.replace("\n", "")
