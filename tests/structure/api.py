"""The page of the Python API, from the docstrings: `python -m tests.structure.api` writes docs/api.md."""

import ast
import inspect
import re
import textwrap
from collections.abc import Iterator
from functools import cached_property
from typing import Any

import panolog
from tests.structure.rules import ROOT

PAGE = ROOT / "docs/api.md"
WIDTH = 100  # of a signature in one line
# Versions are semantic in these names: none goes without a new major version.
_NAMES = {
    "Rendering": "rasterize Raster render Render Camera smooth_path",
    "Losses": "photometric_loss PhotometricLoss inverse_depth_loss sphere_rows ssim_map",
    "A training loop of your own": "initial_gaussians load_views TrainingView Clone3DGS Relocate",
    "Training and its events": "train evaluate Progress Preview Notice LeftOut Checkpoint Trained",
    "Runs": "run resume RunConfig load_config RunState local_pool",
    "Scenes and models": "read_scene Scene Gaussians read_ply write_ply",
    "Importers": "import_scene register_format ImportFormat ImportSource ImportedScene PosedImage"
    " find_panorama",
    "Errors": "PanologError InputError SceneError ConfigError DeviceError MissingPackageError RunLockedError"
    " RunError",
}
SECTIONS = {title: names.split() for title, names in _NAMES.items()}
HEAD = """\
# The Python API

What `import panolog` offers, from the docstrings: `python -m tests.structure.api` writes this page. What
`pip install panolog` brings is enough for all of it but the importers, which need `panolog[prepare]`.
Versions are [semantic](https://semver.org) in these names, their arguments and their fields: what is not on
this page, such as `panolog.renderer` and the other packages, may change in any version.

In the examples, `SCENE` is the folder of a small scene and `MODEL` a PLY of it; the tests run them.
[examples/](../examples/README.md) has whole programs.
"""


def page() -> str:
    """The page as text."""
    return HEAD + "".join(
        f"\n## {title}\n" + "".join(map(_entry, names)) for title, names in SECTIONS.items()
    )


def _entry(name: str) -> str:
    value = getattr(panolog, name)
    if inspect.isclass(value):
        fields = list(_fields(value))
        code = fields or ([] if _of_others(value) else [_signature(name, value)])
    else:
        code = [_signature(name, value)]
    parts = [f"\n### {name}\n", *_documented(code, value)]
    for method, function in _methods(value):
        parts += [f"\n#### {name}.{method}\n", *_documented([_signature(method, function)], function)]
    return "\n".join(parts) + "\n"


def _documented(code: list[str], value: Any) -> list[str]:
    """Code and docstring: the first paragraph as text, the rest as it stands."""
    first, _, rest = (inspect.getdoc(value) or "").partition("\n\n")
    shown = ["```python", *code, "```", ""] if code else []
    return [*shown, first, *(["", "```text", rest, "```"] if rest else [])]


def _of_others(value: Any) -> bool:
    """Whether a class is an error, or has the settings of a run: README.md has those."""
    return value is panolog.RunConfig or issubclass(value, Exception)


def _signature(name: str, value: Any) -> str:
    """As it would be written, in one line or with a line for each argument."""
    if isinstance(value, property | cached_property):
        return name
    signature = inspect.signature(value)
    if len(line := _short(f"{name}{signature}")) <= WIDTH:
        return line
    arguments, keywords = [], False
    for argument in signature.parameters.values():
        if argument.kind is inspect.Parameter.KEYWORD_ONLY and not keywords:
            keywords = True
            arguments.append("*")
        arguments.append(str(argument))
    result = str(signature.replace(parameters=[]))[2:]
    return _short(f"{name}(\n    " + ",\n    ".join(arguments) + f",\n){result}")


def _short(signature: str) -> str:
    """Types without their modules, and no address of a default."""
    signature = re.sub(r"<function .*? at 0x\w+>", "...", signature)
    return re.sub(r"\b(?:[a-z_]\w*\.)+(?=[A-Z])", "", signature)


def _fields(value: type) -> Iterator[str]:
    """The lines of the fields of a class of records, with the comments that say what they are."""
    if _of_others(value):
        return
    lines = textwrap.dedent(inspect.getsource(value)).splitlines()
    (tree,) = ast.parse("\n".join(lines)).body
    assert isinstance(tree, ast.ClassDef)
    for node in tree.body:
        if isinstance(node, ast.AnnAssign) and not ast.unparse(node.annotation).startswith("ClassVar"):
            assert node.end_lineno is not None
            yield from textwrap.dedent("\n".join(lines[node.lineno - 1 : node.end_lineno])).splitlines()


def _methods(value: Any) -> Iterator[tuple[str, Any]]:
    """Public methods and properties with a docstring, those of bases of ours included."""
    if not inspect.isclass(value) or _of_others(value):
        return
    ours = [each for each in value.__mro__ if each.__module__.startswith("panolog.")]
    for name in dict.fromkeys(name for each in ours for name in vars(each) if not name.startswith("_")):
        found = inspect.getattr_static(value, name)
        if isinstance(found, property | cached_property) and found.__doc__:
            yield name, found
        elif inspect.isfunction(function := getattr(value, name)) and function.__doc__:
            yield name, function


if __name__ == "__main__":
    PAGE.write_text(page())
