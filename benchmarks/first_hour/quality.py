"""A town, reconstructed from images to metrics on the card and on the CPU, and a scene on the card."""

import json
import shlex
import time
from dataclasses import asdict, dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import panolog
from benchmarks import runs
from benchmarks.first_hour.outcome import Context, Outcome
from benchmarks.report import markdown
from panolog.orchestrator.cli.commands.demo import SETTINGS
from panolog.orchestrator.engine.driver.local_pool import local_pool
from panolog.orchestrator.runs.config import load_config
from panolog.orchestrator.runs.folder import RunFolder
from panolog.synthetic.make import make_town

HEAD = ("device", "PSNR", "SSIM", "WS-PSNR", "Gaussians", "seconds")
_WORSE = 1.0  # dB that the card may be below the CPU: their sums differ, and so do the paths of training
Settings = dict[str, Any]  # by dotted key
_TINY: Settings = {"iterations": 60, "sky.count": 500, "checkpoint.every": 30, "preview.every": 30}
_SCENE: Settings = {"iterations": 1500, "width": 1024, "blocks": "2x1x1", "checkpoint.every": 500}


@dataclass(frozen=True)
class Result:
    """A finished run: means over the held-out panoramas, wall-clock seconds with the start of all workers."""

    device: str
    psnr: float  # dB, as ws_psnr
    ssim: float
    ws_psnr: float
    gaussians: int
    seconds: float


def demo(context: Context) -> Outcome:
    """The demo's town and settings, on the card and on the CPU."""
    size: dict[str, Any] = {} if context.cuda else {"panoramas": 9, "width": 64, "points": 500}
    town = make_town(context.work / "town", **size)
    settings = SETTINGS if context.cuda else SETTINGS | _TINY
    command = "panolog demo" if context.cuda else _command(town, settings, "cpu")
    results = [reconstruct(context, town, context.device, settings)]
    if context.cuda:
        context.save(outcome_of(results, command))
        results.append(reconstruct(context, town, "cpu", settings))
    return outcome_of(results, command)


def scene(context: Context) -> Outcome:
    """The scene of the options, with few iterations."""
    if context.scene is None:
        return Outcome("skipped", reason="no --scene DIR was given")
    settings = _SCENE if context.cuda else _SCENE | _TINY | {"width": 64}
    place = Path(context.scene)
    result = reconstruct(context, place, context.device, settings)
    return outcome_of([result], _command(place, settings, context.device))


def outcome_of(results: list[Result], command: str) -> Outcome:
    """The outcome of runs on some devices: failed if the first is much worse than the last, the CPU."""
    figure = "PSNR " + ", ".join(f"{result.psnr:.2f} dB on {result.device}" for result in results)
    content = {"runs": [asdict(result) for result in results]}
    text = markdown(HEAD, [tuple(asdict(result).values()) for result in results])
    if results[0].psnr < results[-1].psnr - _WORSE:
        return Outcome("failed", figure, f"more than {_WORSE:g} dB below the CPU", (command,), content, text)
    return Outcome("passed", figure, "", (command,), content, text)


def reconstruct(context: Context, place: Path, device: str, settings: Settings) -> Result:
    """Trains, merges and evaluates a scene by the command, or without Ray if that is not installed."""
    root = context.work / f"run-{device}"
    began = time.monotonic()
    if find_spec("ray"):
        runs.panolog("run", str(place), "-o", str(root), *_options(settings, device))
    else:
        print("Ray is not installed: panolog.run with a pool of local processes", flush=True)
        with local_pool() as pool:
            panolog.run(place, root, load_config(flags=settings | {"device": device}), pool=pool)
    seconds = time.monotonic() - began
    metrics = json.loads(RunFolder(root).metrics.read_bytes())
    means = {name: metrics["mean"][name] for name in ("psnr", "ssim", "ws_psnr")}
    return Result(device, **means, gaussians=metrics["gaussians"], seconds=seconds)


def _command(place: Path, settings: Settings, device: str) -> str:
    return f"panolog run {place.name} -o RUN {shlex.join(_options(settings, device))}"


def _options(settings: Settings, device: str) -> list[str]:
    """Settings as options of `panolog run`."""
    sets = [part for key, value in settings.items() for part in ("--set", f"{key}={json.dumps(value)}")]
    return ["--device", device, *sets]
