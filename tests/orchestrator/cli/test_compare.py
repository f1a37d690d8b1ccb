"""`panolog compare`, and `panolog report` of several runs: what they print, and how they fail."""

import json
from pathlib import Path

import pytest

from panolog.orchestrator.runs.folder import RunFolder
from tests.orchestrator.cli.program import call, one_line
from tests.orchestrator.watch.views.comparison.runs import metrics, write

ESCAPE = "\x1b[31m\x1b]0;title\x07red"


@pytest.fixture
def two(tmp_path: Path) -> tuple[RunFolder, RunFolder]:
    first = write(tmp_path / "paper", measured=metrics())
    higher = metrics({"a.jpg": 21.5, "b.jpg": 23.5, "c.jpg": 30.0})
    return first, write(tmp_path / "panolog", measured=higher, recipe="paper", seed=5)


def test_the_table_and_what_is_not_fair(two: tuple[RunFolder, RunFolder], tmp_path: Path) -> None:
    result = call("compare", *(folder.root for folder in two))
    assert (result.exit_code, result.stderr) == (0, "")
    lines = result.stdout.splitlines()
    rows = {line[:24].strip(): line[24:].split() for line in reversed(lines)}  # the first of each name
    assert lines[0].split() == ["paper", "panolog"]
    assert rows["state"] == ["done", "done"]
    assert rows["WS-PSNR, dB"] == ["24.00", "25.00", "+1.00"]
    assert rows["better, worse in"] == ["2,", "1", "of", "3"]
    assert (rows["time"], rows["Stage I"]) == (["3:10", "3:10"], ["1:00", "1:00"])
    assert rows["seed"] == ["0", "5"]
    other = write(tmp_path / "other", fingerprint="0" * 64, measured=metrics(crop_bottom=0.1))
    lines = call("compare", two[0].root, other.root).stdout.splitlines()
    assert [line for line in lines if line.startswith("not fair: ")] == [
        "not fair: not of the same scene: paper ffffffffffff, other 000000000000",
        "not fair: not measured with the same crop at the bottom: paper 0, other 0.1",
    ]


def test_a_page_is_written_by_either_command(two: tuple[RunFolder, RunFolder], tmp_path: Path) -> None:
    roots = [folder.root for folder in two]
    page = tmp_path / "page.html"
    for arguments in (("compare", *roots, "-o", page), ("report", *roots, "-o", page)):
        result = call(*arguments)
        assert (result.exit_code, result.stdout.splitlines()[-1]) == (0, str(page))
        assert page.is_file()
        page.unlink()
    result = call("compare", *roots, "-o", page, "--json")
    content = json.loads(result.stdout)
    assert (content["first"], [run["name"] for run in content["runs"]]) == (0, ["paper", "panolog"])
    assert str(page) in result.stderr
    assert page.is_file()
    assert not two[0].report.exists()


def test_wrong_arguments_are_one_line(two: tuple[RunFolder, RunFolder], tmp_path: Path) -> None:
    first, second = (folder.root for folder in two)
    assert "needs two runs or more" in one_line(call("compare", first))
    assert "is given twice" in one_line(call("compare", first, first / ".." / "paper"))
    assert f"{tmp_path}: is not a run folder" in one_line(call("compare", first, tmp_path))
    assert "/nowhere: is not a run folder" in one_line(call("compare", first, "/nowhere"))
    assert "at most 8 runs" in one_line(call("compare", *[first] * 9))
    assert "give -o FILE.html" in one_line(call("report", first, second))
    for command in ("report", "compare"):
        assert "the page is HTML" in one_line(call(command, first, second, "-o", tmp_path / "page.pdf"))
    gone = tmp_path / "none" / "page.html"
    assert "there is no such folder" in one_line(call("report", first, second, "-o", gone))
    second.joinpath("run.json").write_text("{")
    assert "is not JSON" in one_line(call("compare", first, second))
    assert "is not JSON" in one_line(call("report", first, second, "-o", tmp_path / "page.html"))
    assert not (tmp_path / "page.html").exists()


def test_a_name_is_no_command_to_the_terminal(two: tuple[RunFolder, RunFolder], tmp_path: Path) -> None:
    evil = write(tmp_path / ESCAPE, measured=metrics({f"{ESCAPE}.jpg": 20.0}), fingerprint=ESCAPE)
    info = json.loads(evil.info.read_bytes())
    info["config"][ESCAPE] = ESCAPE
    info["config"]["recipe"] = "[bold]x[/bold]"
    evil.info.write_text(json.dumps(info))
    result = call("compare", two[0].root, evil.root)
    assert result.exit_code == 0
    assert "\x1b" not in result.stdout
    assert "\x07" not in result.stdout
    assert "[bold]x[/bold]" in result.stdout
