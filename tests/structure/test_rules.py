"""The tree keeps its rules, its plan is drawn from it, and what the documents name is there."""

import doctest
import inspect
import os
import re
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

import panolog
from tests.scenes import write_scene
from tests.structure import rules
from tests.structure.api import PAGE, SECTIONS, page
from tests.structure.plan import PICTURE, picture
from tests.structure.rules import ROOT, text, tracked


@pytest.mark.parametrize("rule", rules.RULES, ids=lambda rule: str(rule.__name__))
def test_the_tree_keeps_the_rule(rule: Callable[[], Iterator[str]]) -> None:
    assert not list(rule())


def test_the_picture_is_that_of_the_code() -> None:
    assert PICTURE.read_text() == picture(), "make it again: .venv/bin/python -m tests.structure.plan"


DOCUMENTS = [file for file in tracked() if file.suffix == ".md"]
_NAMED = re.compile(r"`([\w./-]+/[\w.-]*\.(?:py|pyi|h|cu|cpp|md|yaml|toml|txt|js|ts)|[\w-]+(?:/[\w-]+)*/)`")
_LINK = re.compile(r"\]\(([^)#\s]+)[^)]*\)")
_DEFINED = re.compile(r"((?:`[\w.]+`, )*`[\w.]+`) (?:in|of) `([\w/.-]+\.py)`")  # names, and their file
# Folders of a scene or a run, not of the repository; and files of other projects.
_ELSEWHERE = re.compile(
    r"(RUN|test|images|imgs|masks|skymasks|depths|sparse|control|dist|runs|eval|coarse|blocks|partition)/"
)


@pytest.mark.parametrize("document", DOCUMENTS, ids=str)
def test_paths_and_links_exist(document: Path) -> None:
    content = text(document)
    named = [path for path in _NAMED.findall(content) if not _ELSEWHERE.match(path)]
    linked = [path for path in _LINK.findall(content) if "://" not in path]
    missing = [
        path for path in named if not (ROOT / path).exists() and not (ROOT / document.parent / path).exists()
    ]
    missing += [path for path in linked if not (ROOT / document.parent / path).exists()]
    for names, path in _DEFINED.findall(content):
        defined = text(Path(path)) if (ROOT / path).exists() else ""
        last = [name.rpartition(".")[2] for name in re.findall(r"`([\w.]+)`", names)]
        missing += [f"{name} in {path}" for name in last if not re.search(rf"\b{name}\b", defined)]
    assert not missing


OPTIONS = doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE
# Names without an example: records that others return, errors, and what needs more than a page to show.
WITHOUT = {
    *SECTIONS["Errors"],
    *SECTIONS["Importers"],
    *SECTIONS["Runs"],
    *("Raster", "Render", "PhotometricLoss", "TrainingView", "Scene"),
    *("Progress", "Preview", "Notice", "LeftOut", "Checkpoint", "Trained"),
}
SHOWN = [name for names in SECTIONS.values() for name in names if name not in WITHOUT]


def test_the_page_is_that_of_the_docstrings() -> None:
    assert PAGE.read_text() == page(), "make it again: .venv/bin/python -m tests.structure.api"


def test_the_page_has_every_public_name_once() -> None:
    names = [name for names in SECTIONS.values() for name in names]
    assert sorted(names) == sorted(set(panolog.__all__) - {"__version__"})


@pytest.fixture(scope="module")
def given(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """What the examples begin with."""
    folder = tmp_path_factory.mktemp("given")
    scene, model = write_scene(folder / "scene"), folder / "model.ply"
    panolog.write_ply(model, panolog.initial_gaussians(panolog.read_scene(scene)))
    return {"SCENE": str(scene), "MODEL": str(model)}


@pytest.mark.parametrize("name", SHOWN)
def test_its_example_runs(name: str, given: dict[str, str], tmp_path: Path) -> None:
    documentation = inspect.getdoc(getattr(panolog, name)) or ""
    test = doctest.DocTestParser().get_doctest(documentation, dict(given), name, None, None)
    assert test.examples
    before = Path.cwd()
    os.chdir(tmp_path)
    try:
        failed, _ = doctest.DocTestRunner(optionflags=OPTIONS).run(test)
    finally:
        os.chdir(before)
    assert not failed
