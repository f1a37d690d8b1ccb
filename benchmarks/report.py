"""What all benchmarks say in the same way: the machine, errors, JSON or a table."""

import argparse
import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch

from panolog.orchestrator.resources.machine import cores
from panolog.renderer import _core
from panolog.renderer.process import choose_device, prepare
from panolog.scene.errors import PanologError

Content = dict[str, Any]  # as JSON has it


def numbers(text: str) -> list[int]:
    """Of an option, a comma between two."""
    return [int(part) for part in text.split(",")]


def add_options(parser: argparse.ArgumentParser) -> None:
    """The options that all benchmarks have."""
    parser.add_argument("--device", default="cpu", help="cpu, cuda or auto")
    parser.add_argument("--quick", action="store_true", help="small and once: to see that it works")
    parser.add_argument("--json", action="store_true", help="one JSON object on stdout")


def machine(device: str = "cpu") -> dict[str, str | int]:
    """What the numbers were measured on."""
    lines = Path("/proc/cpuinfo").read_text().splitlines()
    names = [line.partition(": ")[2] for line in lines if line.startswith("model name")]
    card = {"gpu": torch.cuda.get_device_name()} if device == "cuda" else {}
    return {
        **card,
        "cpu": names[0] if names else "unknown",
        "cores": cores(),
        "instruction_set": _core.instruction_set(),
        "torch": torch.__version__,
    }


def sentence(found: dict[str, str | int]) -> str:
    """A machine on one line."""
    return ", ".join(f"{key.replace('_', ' ')} {value}" for key, value in found.items())


def run(name: str, options: argparse.Namespace, work: Callable[[], tuple[Content, str]]) -> int:
    """Print what `work` finds, as JSON and as text; returns the exit code of the program.

    The device becomes one of cpu and cuda, and memory is kept between iterations, as a training worker does.
    """
    try:
        options.device = choose_device(options.device)
        prepare(cores())
        content, text = work()
    except PanologError as error:
        print(f"{name}: {error}", file=sys.stderr)
        return 2
    if options.json:
        print(json.dumps({"machine": machine(options.device), **content}, indent=2))
    else:
        print(sentence(machine(options.device)), text, sep="\n\n")
    return 0
