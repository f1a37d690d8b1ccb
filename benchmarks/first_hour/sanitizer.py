"""NVIDIA's compute-sanitizer over the renderer's tests on the card: one tool in each step."""

import importlib.util
import os
import re
import shlex
import shutil
from collections import Counter
from dataclasses import replace
from pathlib import Path

from benchmarks.first_hour import suites
from benchmarks.first_hour.outcome import ROOT, Context, Outcome

WHEEL = (
    "'nvidia-cuda-sanitizer-api>=13.5'"  # earlier ones lack what starts the target, in a folder of its own
)
_TESTS = "tests/renderer"
_KERNELS = "renderer/csrc/cuda"  # a kernel's name begins with that of its file
# torch gives each tensor an allocation of its own, so that an access beyond one is beyond its allocation
_ENVIRONMENT = {"PYTORCH_NO_CUDA_MEMORY_CACHING": "1"}
_COMMON = ("--target-processes", "application-only", "--report-api-errors", "no", "--print-limit", "1000")
_OURS_ALONE = ("racecheck", "synccheck")  # need no kernel of torch, and are slow
_SUMMARY = re.compile(r"(?:ERROR|RACECHECK) SUMMARY: (\d+) (?:errors?|hazards?)")
_AT = re.compile(r"\bat (?:void )?(\w[^+\n]*)\+0x")
_SHOWN = 20  # kernels on the page
_SHARE = 0.9  # of the step's time, after which the tool is stopped


def find_program() -> Path | None:
    """compute-sanitizer: of PATH, of CUDA_HOME, or of NVIDIA's wheel."""
    homes = [os.environ.get("CUDA_HOME"), os.environ.get("CUDA_PATH"), "/usr/local/cuda"]
    wheels = importlib.util.find_spec("nvidia")  # a namespace of several folders
    parts = [Path(part) for part in (wheels and wheels.submodule_search_locations) or ()]
    folders = [os.environ.get("PATH", ""), *(f"{home}/bin" for home in homes if home)]
    folders += [str(folder) for part in parts for folder in sorted(part.glob("*/compute-sanitizer"))]
    found = shutil.which("compute-sanitizer", path=os.pathsep.join(folders))
    return Path(found) if found else None


def check(context: Context) -> Outcome:
    """The step's tool over the tests of tests/renderer that run on the card."""
    program, tool = find_program(), context.step
    if program is None:
        return Outcome("skipped", reason=f"there is no compute-sanitizer: pip install {WHEEL}, or CUDA_HOME")
    log = context.work / "sanitizer.txt"
    options = ["--tool", tool, *_COMMON]
    if tool in _OURS_ALONE:
        options += ["--kernel-name", f"regex={our_kernels()}"]
    command = [str(program), *options, "--log-file", str(log), *suites.PYTEST, _TESTS]
    suite, whole = suites.run(context, command, _SHARE * context.seconds, _ENVIRONMENT)
    by_hand = " ".join(f"{name}={value}" for name, value in _ENVIRONMENT.items())
    by_hand += f" {shlex.join(['compute-sanitizer', *options])} {suites.BY_HAND} {_TESTS}"
    outcome = suites.judged(context, suite, (by_hand,), whole=whole)
    return judged(outcome, log.read_text(errors="replace") if log.exists() else "")


def our_kernels() -> str:
    """A regular expression for the names of the package's kernels."""
    stems = sorted(path.stem for path in Path(ROOT, _KERNELS).glob("*.cu"))
    return f"^({'|'.join(stems)})_"


def judged(tests: Outcome, log: str) -> Outcome:
    """The outcome of a tool: failed if the tests did, if a kernel of ours is reported, or if it did not run.

    Args: tests, the outcome of the tests; log, what the tool reports.
    """
    summary = _SUMMARY.search(log)
    if summary is None:
        said = [line.strip("= ") for line in log.splitlines() if "rror" in line]
        why = said[0] if said else "it wrote no summary"
        reason = "; ".join(filter(None, [f"compute-sanitizer: {why}", tests.reason]))
        return replace(tests, ending="failed", reason=reason)
    kernels = reported(log)
    ours = {name: count for name, count in kernels.items() if re.match(our_kernels(), name)}
    count = int(summary[1])
    lines = [f"- {number} × `{name}`" for name, number in kernels.most_common(_SHOWN)]
    text = "\n".join([*lines, tests.text]).strip()
    content = {**tests.content, "reports": count, "kernels": dict(kernels)}
    figure = f"{count} reports, {sum(ours.values())} of them in our kernels; {tests.figure}"
    made = replace(tests, figure=figure, content=content, text=text)
    if ours or (count and not kernels):
        return replace(made, ending="failed", reason=f"reports in {', '.join(ours) or 'no known kernel'}")
    return made


def reported(log: str) -> Counter[str]:
    """How often each kernel is reported: the first that a report names."""
    reports = re.split(r"^========= (?=[A-Z])", log, flags=re.MULTILINE)
    return Counter(found[1].partition("(")[0] for report in reports if (found := _AT.search(report)))
