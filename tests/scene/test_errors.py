"""Errors survive a process boundary, and fit on one line; the extras are those of pyproject.toml."""

import pickle
import re
import sys
from collections.abc import Mapping
from functools import cache
from importlib.metadata import packages_distributions

import grimp
import pytest

from panolog.scene import errors
from panolog.scene.errors import PACKAGES, MissingPackageError, explained, require
from tests.structure.rules import ROOT


@pytest.mark.parametrize(
    "kind",
    [
        kind
        for kind in vars(errors).values()
        if getattr(kind, "__module__", "") == errors.__name__ and isinstance(kind, type)
    ],
)
def test_an_error_survives_pickling(kind: type[errors.PanologError]) -> None:
    copy = pickle.loads(pickle.dumps(kind("scene/sparse/0: damaged; export it again")))
    assert (type(copy), str(copy)) == (kind, "scene/sparse/0: damaged; export it again")


def test_an_error_in_one_line() -> None:
    assert errors.in_one_line(ValueError("line 3:\n   no\tcolon ")) == "line 3: no colon"
    assert errors.in_one_line(ValueError("line 3: no colon"), 6) == "line 3"
    assert errors.in_one_line(TimeoutError()) == "TimeoutError"


if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
EXTRAS: dict[str, list[str]] = PROJECT["optional-dependencies"]


def distributions(extra: str) -> set[str]:
    """The distributions of an extra and of those that it includes."""
    found = set()
    for requirement in EXTRAS[extra]:
        name, included = re.match(r"([\w.-]+)(?:\[([\w,]+)\])?", requirement).groups()  # type: ignore[union-attr]
        if name == "panolog":
            found |= set().union(*map(distributions, included.split(",")))
        else:
            found.add(name.lower())
    return found


def distribution(module: str) -> str:
    """What brings a module; a few do not list theirs, and have its name."""
    return known().get(module, [module])[0].lower().replace("_", "-")


@cache
def known() -> Mapping[str, list[str]]:
    """The distributions of each module that is installed."""
    return packages_distributions()


def test_each_package_is_of_the_extra_that_is_named_and_not_of_the_core() -> None:
    core = " ".join(PROJECT["dependencies"]).lower()
    for module, (_, extra) in PACKAGES.items():
        assert distribution(module) in distributions(extra), module
        assert distribution(module) not in core, module
    ours = set(map(distribution, PACKAGES))
    for extra in ("prepare", "cluster", "dashboard", "export"):
        assert distributions(extra) <= ours & distributions("all")


def test_every_package_that_a_module_imports_is_declared() -> None:
    names = [*PROJECT["dependencies"], *(it for extra in EXTRAS.values() for it in extra), "markupsafe"]
    declared = {re.split(r"[^\w.-]", name)[0].lower() for name in names}
    declared |= {"cuda", "mlflow"}  # namespaces of cuda-core and mlflow-skinny
    graph = grimp.build_graph("panolog", include_external_packages=True, cache_dir=None)
    others = {module for module in graph.modules if module.partition(".")[0] != "panolog"}
    for module in others - sys.stdlib_module_names:
        ours = {distribution(module), module, module.replace("_", "-")}
        assert not ours.isdisjoint(declared), (module, graph.find_modules_that_directly_import(module))


def test_a_missing_package_is_one_line_with_its_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    said = explained(ModuleNotFoundError("No module named 'ray.util'", name="ray.util"))
    assert str(said) == "this needs Ray: pip install 'panolog[cluster]'"
    assert explained(ModuleNotFoundError("No module named 'numpy'", name="numpy")) is None
    assert explained(ModuleNotFoundError()) is None
    require("matplotlib")
    monkeypatch.setitem(PACKAGES, "no_such_module", ("Nothing", "export"))
    with pytest.raises(MissingPackageError, match=r"^this needs Nothing: pip install 'panolog\[export\]'$"):
        require("no_such_module")
