"""What all benchmarks share: the common options, the description of the machine, tables, and one output."""

import argparse
import json
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from panolog.scene.errors import InputError, PanologError


@dataclass(frozen=True)
class Report:
    """The result of a benchmark."""

    content: dict[str, Any]  # for --json
    text: str  # Markdown
    passed: bool = True  # whether the goals that decide the exit code are met


def numbers(text: str) -> list[int]:
    """The value of an option: integers separated by commas."""
    return [int(part) for part in text.split(",")]


def parser(name: str, description: str | None, *, quick: bool = True) -> argparse.ArgumentParser:
    """A parser with the options of all benchmarks; its help shows the first paragraph of `description`."""
    summary = (description or "").split("\n\n")[0]
    made = argparse.ArgumentParser(prog=f"python -m benchmarks.{name}", description=summary)
    if quick:
        made.add_argument("--quick", action="store_true", help="small: only to check that it works")
    made.add_argument("--json", action="store_true", help="one JSON object on stdout")
    return made


def run(name: str, options: argparse.Namespace, work: Callable[[], Report]) -> int:
    """Prints the report of `work`, with --json as one object.

    Returns the exit code: 0, 1 if a goal is missed or a run failed, 2 if the input is wrong.
    """
    try:
        report = work()
    except PanologError as error:
        print(f"{name}: {error}", file=sys.stderr)
        return 2 if isinstance(error, InputError) else 1
    measured_on = machine(getattr(options, "device", "cpu"))
    if options.json:
        print(json.dumps({"machine": measured_on, **report.content}, indent=2))
    else:
        print(sentence(measured_on), report.text, sep="\n\n")
    return 0 if report.passed else 1


def machine(device: str = "cpu") -> dict[str, str | int]:
    """The hardware and versions that a measurement belongs to."""
    import torch  # noqa: PLC0415  # a table needs none of these, and a page must survive what breaks them

    from panolog.orchestrator.runs.machines.machine import cores  # noqa: PLC0415
    from panolog.renderer import _core  # noqa: PLC0415

    lines = Path("/proc/cpuinfo").read_text().splitlines()
    names = [line.partition(": ")[2] for line in lines if line.startswith("model name")]
    gpu = {"gpu": torch.cuda.get_device_name()} if device == "cuda" else {}
    return {
        **gpu,
        "cpu": names[0] if names else "unknown",
        "cores": cores(),
        "instruction_set": _core.instruction_set(),
        "torch": torch.__version__,
    }


def sentence(found: dict[str, str | int]) -> str:
    """A machine on one line."""
    return ", ".join(f"{key.replace('_', ' ')} {value}" for key, value in found.items())


def markdown(head: Sequence[str], rows: Sequence[Sequence[object]]) -> str:
    """A Markdown table; floats with four significant digits, integers in groups of three, None as a dash."""
    cells = [list(head), *([cell(value) for value in row] for row in rows)]
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    lines = ["| " + " | ".join(map(str.ljust, row, widths)) + " |" for row in cells]
    rule = "|" + "|".join("-" * (width + 2) for width in widths) + "|"
    return "\n".join([lines[0], rule, *lines[1:]])


def cell(value: object) -> str:
    """A value as a table shows it."""
    if value is None:
        return "–"
    if isinstance(value, float):
        integer_digits = len(str(int(abs(value)))) if abs(value) >= 1 else 0
        return f"{value:,.{max(0, 4 - integer_digits)}f}"
    return f"{value:,}" if isinstance(value, int) else str(value)
