"""A row of `benchmarks.inputs` is right, clear or wrong by exit code and words."""

import json
from pathlib import Path

import pytest

from benchmarks import inputs

MAKER = "import pathlib, sys\npathlib.Path(sys.argv[2]).write_text(sys.argv[1])\n"
COMMAND = """#!/bin/bash
echo "$(cat "$2") $1 is read"
if [ "$(cat "$2")" = broken ]; then echo "panolog: save it again" >&2; exit 2; fi
"""
TABLE = """
- maker: public/a.py
  make: "{case} {out}"
  commands: 'read {out}'
  right: 'is read'
  cases: >-
    sound broken
  others:
    other: '+other'
"""


def test_rows_are_judged_kept_and_compared(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "cases" / "public").mkdir(parents=True)
    (tmp_path / "cases" / "captures").mkdir()
    (tmp_path / "cases" / "public" / "a.py").write_text(MAKER)
    (tmp_path / "cases" / "captures" / "mkmodel.py").touch()
    (tmp_path / "table.yaml").write_text(TABLE)
    command = tmp_path / "panolog"
    command.write_text(COMMAND)
    command.chmod(0o755)
    monkeypatch.setattr(inputs, "TABLE", tmp_path / "table.yaml")
    monkeypatch.setattr(inputs, "make_town", lambda *_, **__: None)
    saved, page = tmp_path / "rows.json", tmp_path / "page.md"
    page.write_text("# Title\n\n| maker |\nold\n")
    given = [str(tmp_path / "cases"), "--panolog", str(command), "--save", str(saved), "-o", str(page)]
    assert inputs.main([*given, "--before", str(saved)]) == 1
    found = {row["case"]: (row["code"], row["verdict"], row["said"]) for row in json.loads(saved.read_text())}
    assert found["sound"] == (0, "right", "sound read is read")
    assert found["broken"] == (2, "wrong", "panolog: save it again")
    assert found["other"][:2] == (0, "right")
    assert "old" not in page.read_text() and page.read_text().startswith("# Title\n\n| maker")
    table = tmp_path / "table.yaml"
    table.write_text(
        TABLE.replace("sound broken", "sound").replace("'+other'", "'+other'\n    broken: save it")
    )
    assert inputs.main([*given, "--only", "broken"]) == 0
    assert {row["case"]: row["verdict"] for row in json.loads(saved.read_text())}["broken"] == "clear"
