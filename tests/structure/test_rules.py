"""The tree keeps its rules, its plan is drawn from it, and what the documents name is there."""

import re
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from tests.structure import rules
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
