"""What each CUDA kernel takes of a card: registers, shared memory, spills. Needs no card.

    python -m benchmarks.cuda_resources [--arch sm_89,sm_120] [--json]

NVRTC compiles every module for every architecture, as a card's first use does, and reports what
tests/renderer/cuda/resources.py reads.
"""

import sys
from collections.abc import Sequence
from dataclasses import asdict

from benchmarks import report
from panolog.renderer.cuda import nvrtc
from tests.renderer.cuda.resources import ARCHITECTURES, Kernel, measure


def table(kernels: Sequence[Kernel]) -> str:
    """A row for each kernel: the most over all architectures; registers for each."""
    architectures = list(dict.fromkeys(kernel.arch for kernel in kernels))
    rows = []
    for name in dict.fromkeys(kernel.name for kernel in kernels):
        own = [kernel for kernel in kernels if kernel.name == name]
        most = [
            max(getattr(kernel, field) for kernel in own)
            for field in ("shared", "stack", "spills", "doubles")
        ]
        rows.append([name, *most, *(kernel.registers for kernel in own)])
    head = ("kernel", "shared B", "stack B", "spills B", "f64", *architectures)
    return report.markdown(head, rows) + "\n\nUnder each architecture: registers."


def main(arguments: Sequence[str] | None = None) -> int:
    """The program; returns its exit code."""
    parser = report.parser("cuda_resources", __doc__, quick=False)
    parser.add_argument("--arch", default=",".join(ARCHITECTURES), help="separated by commas")
    options = parser.parse_args(arguments)

    def work() -> report.Report:
        found = [
            k for arch in options.arch.split(",") for module in nvrtc.MODULES for k in measure(module, arch)
        ]
        compiler = "NVRTC {}.{}".format(*nvrtc.nvrtc_version()[:2])
        content = {"compiler": compiler, "kernels": [asdict(kernel) for kernel in found]}
        return report.Report(content, f"{table(found)} {compiler}.")

    return report.run("cuda_resources", options, work)


if __name__ == "__main__":
    sys.exit(main())
