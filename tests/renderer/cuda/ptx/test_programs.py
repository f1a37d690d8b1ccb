"""NVRTC's own code for every architecture: all of it is translated, and right. test_kernels.py runs more."""

import pytest

from panolog.renderer.cuda.nvrtc import MODULES
from tests.renderer.cuda.ptx import PROGRAMS, Program, emulated_ptx, ptx_of, translated
from tests.renderer.cuda.resources import ARCHITECTURES
from tests.renderer.cuda.test_mutants import EXERCISES

pytestmark = pytest.mark.system

RUN = ("sm_89", "sm_120")  # the architectures of PROGRAMS


@pytest.mark.parametrize(
    "name", [name if name == "sm_89" else pytest.param(name, marks=pytest.mark.nightly) for name in PROGRAMS]
)
def test_the_compilers_code_is_right(name: str) -> None:
    for exercise in dict.fromkeys(EXERCISES.values()):
        exercise(emulated_ptx(PROGRAMS[name]))


@pytest.mark.nightly
@pytest.mark.parametrize("cuda12", [False, True])
@pytest.mark.parametrize("arch", ARCHITECTURES)
def test_each_architecture_has_the_code_of_one_that_runs(arch: str, cuda12: bool) -> None:
    """What a compiler makes for others is the same to the letter; where that ends, PROGRAMS needs another."""
    for module in MODULES:
        made = translated(module, Program(arch), ptx_of(module, arch, cuda12))
        assert made in [translated(module, Program(run), ptx_of(module, run, cuda12)) for run in RUN]
