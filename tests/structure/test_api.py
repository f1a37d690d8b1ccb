"""The page of the Python API is that of the docstrings, has every public name, and its examples run."""

import doctest
import inspect
import os
from pathlib import Path

import pytest

import panolog
from tests.scenes import write_scene
from tests.structure.api import PAGE, SECTIONS, page

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
