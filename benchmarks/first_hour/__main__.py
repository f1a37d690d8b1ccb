"""Tests, checks and measures the CUDA kernels on this machine's card, and writes one page.

    python -m benchmarks.first_hour -o FOLDER [--minutes 25] [--scene DIR [--model PLY]] [--only STEP,...]
    python -m benchmarks.first_hour -o FOLDER --device cpu    # a rehearsal without a card

Each step is a process of its own with its own time limit. After each of them FOLDER/first-hour.md and
FOLDER/first-hour.json are written anew. Steps that are not run keep what FOLDER has of them from before.
"""

import argparse
import importlib.util
import shlex
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict
from datetime import datetime
from functools import partial
from pathlib import Path
from typing import Any

from benchmarks.first_hour.steps import STEPS, limit

INSTALL = "PanoLOG is not installed for this Python; benchmarks/README.md says how, also without network"
_LEAST_S = 2.0  # in which no step can do anything
_LINE = 100  # characters of a log on stderr
OUTPUT = Path("runs/first-hour")


def parse(arguments: Sequence[str] | None = None) -> argparse.Namespace:
    """The command line; what is wrong with it ends the program with exit code 2."""
    steps = "".join(f"  {name:<12} {step.what}\n" for name, step in STEPS.items())
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.first_hour",
        description=(__doc__ or "").partition("\n")[0],
        epilog=f"steps, the most important first:\n{steps}",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("-o", "--output", type=Path, default=OUTPUT, metavar="FOLDER", help="of all results")
    parser.add_argument("--device", choices=("cuda", "cpu"), default="cuda", help="cpu: a rehearsal")
    parser.add_argument("--minutes", type=float, default=25, help="for all steps together (25)")
    parser.add_argument("--scene", type=Path, metavar="DIR", help="a scene to train, besides the demo's town")
    parser.add_argument(
        "--model", type=Path, metavar="PLY", help="trained on the scene, to measure its speed"
    )
    parser.add_argument(
        "--only", type=_steps, metavar="STEP,...", default=list(STEPS), help="run these steps"
    )
    options = parser.parse_args(arguments)
    if not options.minutes > 0:
        parser.error(f"--minutes {options.minutes:g}: must be above 0")
    if options.scene is not None and not options.scene.is_dir():
        parser.error(f"--scene {options.scene}: there is no such folder")
    if options.model is not None and (options.scene is None or not options.model.is_file()):
        parser.error(f"--model {options.model}: must be a file, and needs the --scene it was trained on")
    options.steps = [name for name in STEPS if name in options.only]
    return options


def _steps(text: str) -> list[str]:
    names = text.split(",")
    for name in names:
        if name not in STEPS:
            raise argparse.ArgumentTypeError(f"{name!r} is none of {', '.join(STEPS)}")
    return names


def _say(line: str) -> None:
    print(f"{datetime.now():%H:%M:%S} {line}", file=sys.stderr, flush=True)


def _progress(name: str, seconds: float, line: str) -> None:
    _say(f"{name}: {seconds:.0f} s: {line[:_LINE]}")


def main(arguments: Sequence[str] | None = None) -> int:
    """The program; returns its exit code: 0, 1 if a step failed, 2 for bad options, 130 if interrupted."""
    options = parse(arguments)
    if importlib.util.find_spec("panolog") is None:
        print(INSTALL, file=sys.stderr)
        return 2
    from benchmarks.first_hour import page  # noqa: PLC0415  # these import the package

    folder = options.output.resolve()
    try:
        folder.mkdir(parents=True, exist_ok=True)
        before = page.read(folder)
    except (OSError, ValueError) as error:
        print(f"first_hour: --output {options.output}: {error}", file=sys.stderr)
        return 2
    if before and before["device"] != options.device:
        kept = f"first_hour: {folder} has results of --device {before['device']}: take another folder"
        print(kept, file=sys.stderr)
        return 2
    content = {
        "command": "python -m benchmarks.first_hour " + shlex.join(arguments or sys.argv[1:]),
        "device": options.device,
        "minutes": options.minutes,
        "began": f"{datetime.now():%Y-%m-%d %H:%M}",
        "steps": before["steps"] if before else {},
    }
    try:
        _run(options, folder, content)
    except KeyboardInterrupt:
        _say(f"interrupted; {folder / page.NAME}.md has what was done")
        return 130
    _say(f"done: {folder / page.NAME}.md")
    failed = [name for name in options.steps if content["steps"][name]["ending"] == "failed"]
    return 1 if failed else 0


def _run(options: argparse.Namespace, folder: Path, content: dict[str, Any]) -> None:
    """Runs the steps, each with its share of the time that is left, and writes the page after each."""
    from benchmarks.first_hour import page, supervise  # noqa: PLC0415  # these import the package
    from benchmarks.first_hour.outcome import Context, Outcome  # noqa: PLC0415

    ends = time.monotonic() + 60 * options.minutes
    scene, model = (path and str(path.resolve()) for path in (options.scene, options.model))
    for number, name in enumerate(options.steps):
        seconds = limit(options.steps[number:], ends - time.monotonic())
        if seconds < _LEAST_S:
            outcome = Outcome("skipped", reason=f"no time was left of --minutes {options.minutes:g}")
            content["steps"][name] = {**asdict(outcome), "seconds": 0.0, "limit": 0.0}
            page.write(folder, content)
            continue
        unfinished = asdict(Outcome("failed", reason="not finished: the program ended in this step"))
        content["steps"][name] = {**unfinished, "seconds": 0.0, "limit": seconds}
        page.write(folder, content)
        _say(f"{name}: {STEPS[name].what} (at most {seconds:.0f} s)")
        ran = supervise.run(
            Context(name, str(folder), options.device, seconds, scene, model), partial(_progress, name)
        )
        content["steps"][name] = {**asdict(ran.outcome), "seconds": round(ran.seconds, 1), "limit": seconds}
        page.write(folder, content)
        _say(f"{name}: {ran.outcome.ending}. {ran.outcome.figure} {ran.outcome.reason}".rstrip())


if __name__ == "__main__":
    sys.exit(main())
