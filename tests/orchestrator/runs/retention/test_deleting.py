"""docs/deleting.md names each place that removes files, and nothing but two places removes from a store."""

import re
from pathlib import Path

from tests.deploy.files import ROOT

REMOVES = re.compile(
    r"\.unlink\(|\brmtree\(|os\.remove\(|os\.unlink\(|\.rmdir\(|shutil\.move\(|\.truncate\(|\.rename\("
)
FROM_STORE = re.compile(r"store\.remove\(|\brm_file\(|\.rm\(")


def modules(pattern: re.Pattern[str]) -> set[str]:
    folders = ("orchestrator", "workers", "scene", "prepare", "export", "renderer", "partition", "synthetic")
    paths = (path for folder in folders for path in (ROOT / folder).rglob("*.py"))
    return {path.relative_to(ROOT).as_posix() for path in paths if pattern.search(path.read_text())}


def test_the_page_names_each_module_that_removes_files() -> None:
    page = (ROOT / "docs/deleting.md").read_text()
    found = modules(REMOVES)
    assert len(found) > 20
    assert {name for name in found if f"`{name}`" not in page} == set()
    named = set(re.findall(r"`([a-z_/]+\.py)`", page)) - {Path(__file__).relative_to(ROOT).as_posix()}
    assert {name for name in named if not Path(ROOT, name).is_file()} == set()


def test_nothing_but_clean_and_the_withdrawal_of_a_refused_run_removes_from_a_store() -> None:
    assert modules(FROM_STORE) == {
        "orchestrator/runs/retention/stores.py",
        "orchestrator/runs/storage/mirror.py",
        "scene/stores/store.py",  # which defines it
    }
    mirror = (ROOT / "orchestrator/runs/storage/mirror.py").read_text()
    assert len(FROM_STORE.findall(mirror)) == 1
    withdrawal = mirror.partition("    def _withdraw(")[2].partition("\n    def ")[0]
    assert FROM_STORE.search(withdrawal)
