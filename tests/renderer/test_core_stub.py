"""renderer/_core.pyi against the signatures that the compiled module reports."""

import ast
import re
from pathlib import Path

from panolog import renderer
from panolog.renderer import _core

STUB = Path(renderer.__file__).with_name("_core.pyi")
ARRAYS = {"float32": "Floats", "int32": "Ints", "float64": "Doubles", "uint8": "Bytes"}


def compiled() -> dict[str, str]:
    """The signature of every function of the module, with the stub's names for arrays."""
    signatures = {
        name: function.__nb_signature__[0][0]
        for name, function in vars(_core).items()
        if hasattr(function, "__nb_signature__")
    }
    array = r"(?:numpy\.)?ndarray\[dtype=(\w+)[^\]]*\]"
    named = {name: re.sub(array, lambda m: ARRAYS[m[1]], text) for name, text in signatures.items()}
    return {name: re.sub(r"\\\d", "None", text) for name, text in named.items()}  # the only default


def test_the_stub_has_every_function_with_its_arguments_in_order() -> None:
    stub = {node.name: node for node in ast.parse(STUB.read_text()).body if isinstance(node, ast.FunctionDef)}
    expected = {name: ast.parse(f"{text}: ...").body[0] for name, text in compiled().items()}
    assert {name: ast.dump(node) for name, node in stub.items()} == {
        name: ast.dump(node) for name, node in expected.items()
    }


def test_arrays_in_the_stub_have_the_types_of_the_module() -> None:
    aliases = re.findall(r"^(\w+) = NDArray\[np\.(\w+)\]$", STUB.read_text(), re.MULTILINE)
    assert {type: name for name, type in aliases} == ARRAYS
