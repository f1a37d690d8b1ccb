"""The pages: links lead to existing files, and the commands that they show exist."""

import re
import shlex
from pathlib import Path

import pytest

from tests.deploy.files import DEPLOY, parsed

PAGES = sorted(DEPLOY.glob("*.md"))


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_lead_somewhere(page: Path) -> None:
    for target in re.findall(r"\]\(([^)#]+)", page.read_text()):
        assert target.startswith("https://") or (DEPLOY / target).exists(), target


def test_every_file_has_a_page() -> None:
    text = "".join(page.read_text() for page in PAGES)
    for file in DEPLOY.iterdir():
        assert file.suffix in (".md", ".dockerignore") or f"{file.name}" in text, file.name


def shown() -> list[list[str]]:
    """The panolog commands in the pages' examples, without optional arguments."""
    examples = [
        line.strip().removeprefix(".venv/bin/")
        for page in PAGES
        for line in page.read_text().splitlines()
        if line.startswith("    ")
    ]
    lines = [
        line.split("#")[0].split("[")[0].rstrip(" \\") for line in examples if line.startswith("panolog ")
    ]
    return [shlex.split(line)[1:] for line in lines]


def test_commands_are_as_the_pages_show_them() -> None:
    assert len(shown()) > 8
    for words in shown():
        parsed(words)
