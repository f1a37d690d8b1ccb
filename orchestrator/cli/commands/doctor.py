"""`panolog doctor`: what this machine has, what is missing and how to fix it; what a run needs."""

import importlib.util
import platform
import shutil
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

import psutil
import torch

from panolog.orchestrator.runs.config import RunConfig
from panolog.orchestrator.runs.machines.machine import cores, memory
from panolog.orchestrator.runs.units import duration, gib
from panolog.renderer.unused_gpu import unused_gpu
from panolog.scene.errors import PACKAGES, InputError, command_for, installed

if TYPE_CHECKING:
    from panolog.orchestrator.engine.estimates.preflight import Preflight
    from panolog.orchestrator.runs.money.prices import PriceList
    from panolog.orchestrator.runs.preparation.settings import Settings
    from panolog.scene.model import Scene

_CPUINFO = Path("/proc/cpuinfo")
_SIMD = ("avx512f", "avx2", "avx", "sse4_2", "asimd")  # best first; the kernels pick at run time


@dataclass(frozen=True)
class Finding:
    """The result of one check. A fatal one prevents a run."""

    what: str
    value: str
    ok: bool = True
    fatal: bool = False
    fix: str = ""  # how to fix it


@dataclass(frozen=True)
class Diagnosis:
    """All findings, and the preflight of a run if there was one."""

    findings: list[Finding]
    preflight: "Preflight | None" = None

    @property
    def ready(self) -> bool:
        """Whether a run can start."""
        return not any(finding.fatal for finding in self.findings)

    def as_json(self) -> dict[str, Any]:
        """What `panolog doctor --json` prints; bytes and seconds."""
        findings = [asdict(finding) | {"mend": finding.fix} for finding in self.findings]  # its former name
        preflight = self.preflight and self.preflight.as_json()
        return {"ready": self.ready, "findings": findings, "preflight": preflight}

    def lines(self) -> Iterator[str]:
        """The findings for people."""
        for it in self.findings:
            mark = "ok" if it.ok else "MISSING" if it.fatal else "note"
            yield f"{mark:8}{it.what}: {it.value}" + (f"; {it.fix}" if it.fix else "")
        if self.preflight is not None:
            yield from self.preflight.workers.lines()


def diagnose(
    source: Sequence[str] | None,
    config: RunConfig,
    address: str | None,
    prices: "PriceList | None" = None,
) -> Diagnosis:
    """Checks this machine and, if it is ready, what a run of `source` needs here or on a cluster.

    Of panoramas or a video the scene is made first, so only what can be known before is said.

    Args: source, a folder or URL of a scene, or panoramas and videos; prices of machines, if known.
    Raises InputError if the scene, the settings or the address are wrong; StoreLostError.
    """
    packages = (_package(module) for module in PACKAGES)
    findings = [
        _cpu(),
        Finding("memory", f"{gib(psutil.virtual_memory().total)}, {gib(memory())} available"),
        Finding("disk", f"{gib(shutil.disk_usage(Path.cwd()).free)} free at {Path.cwd()}"),
        Finding("torch", f"{torch.__version__}, Python {platform.python_version()}"),
        _gpu(),
        _kernels(),
        *packages,
    ]
    machine = Diagnosis(findings)
    if not source or not machine.ready:
        return machine
    # these need the compiled core
    from panolog.orchestrator.cli.session import preparing, session
    from panolog.orchestrator.runs.preparation.settings import Options

    new = preparing.found(source, config, Options())
    if new.settings is not None:
        return Diagnosis([*findings, *_source(new.settings, new.config)])
    assert new.scene is not None  # that it is one of both is what `found` checks
    preflight = session.estimate_run(new.scene, new.config, address, prices)
    return Diagnosis([*findings, *_needs(new.scene, preflight)], preflight)


def _cpu() -> Finding:
    flags = set(_CPUINFO.read_text().split()) if _CPUINFO.is_file() else set()
    simd = next((name for name in _SIMD if name in flags), "none known")
    return Finding("CPU", f"{cores()} cores, {platform.machine()}, best SIMD {simd}")


def _gpu() -> Finding:
    if not torch.cuda.is_available():
        return Finding("GPU", "none that torch can use", ok=False, fix=unused_gpu() or "the CPU is used")
    gpus = [torch.cuda.get_device_properties(i) for i in range(torch.cuda.device_count())]
    value = ", ".join(f"{gpu.name} ({gib(gpu.total_memory)})" for gpu in gpus)
    if _has_core():  # its absence is a finding of its own
        from panolog.renderer.process import choose_device  # it needs the compiled core

        try:
            choose_device("cuda")
        except InputError as error:
            return Finding("GPU", value, ok=False, fatal=True, fix=str(error))
    return Finding("GPU", value)


def _has_core() -> bool:
    return importlib.util.find_spec("panolog.renderer._core") is not None


def _kernels() -> Finding:
    if _has_core():
        return Finding("compiled core", "present")
    fix = "install PanoLOG again: `make setup`, or pip install ."
    return Finding("compiled core", "missing", ok=False, fatal=True, fix=fix)


def _package(module: str) -> Finding:
    if installed(module):
        return Finding(module, version(module))
    return Finding(module, "missing", ok=False, fix=f"some commands need it: {command_for(module)}")


def _source(settings: "Settings", config: RunConfig) -> Iterator[Finding]:
    """What a run makes its scene of. Raises OSError if a panorama is gone meanwhile."""
    from panolog.orchestrator.runs.preparation import forecast
    from panolog.orchestrator.watch.views.preparation import STEPS

    kind = "frames of a video, of which a part is used" if settings.video else "panoramas"
    if settings.others and settings.video:
        kind = "panoramas and frames of videos, of which a part is used"
    of = f"{len(settings.sources)} sources: " if settings.others else ""
    yield Finding("source", f"{of}{settings.panoramas:,} {kind}, {settings.width}x{settings.width // 2}")
    yield Finding("preparation", ", ".join(STEPS[step] for step in settings.steps()))
    making, training = sum(forecast.parts_of(settings).values()), forecast.training(config, settings.width)
    what = f"{duration(making)} to make the scene and {duration(training)} to train"
    yield Finding("time of the job", f"roughly {what}, by what other captures took")
    later = "known once there are poses: the run says it before it trains, and refuses what does not fit"
    yield Finding("the job", f"its memory and disk are {later}")


def _needs(scene: "Scene", preflight: "Preflight") -> Iterator[Finding]:
    """What a run needs, stage by stage, and whether the machines have it."""
    from panolog.orchestrator.engine.estimates.preflight import (  # it needs the compiled core
        machine_line,
        stage_line,
        time_of,
    )
    from panolog.orchestrator.watch.views.summary import STAGES

    held_out = f"{len(scene.train)} to train on, {len(scene.test)} held out"
    estimate, cuda = preflight.estimate, preflight.config.device == "cuda"
    yield Finding("scene", f"{len(scene.panoramas)} panoramas {scene.width}x{scene.height}, {held_out}")
    yield Finding("sparse points", f"{len(scene.points):,}")
    for node in preflight.nodes:
        yield Finding(f"machine {node.host}", machine_line(node))
    yield Finding("blocks", preflight.config.blocks)
    config = preflight.config
    if config.memory and config.densify.max_gaussians:
        cap = f"{config.densify.max_gaussians:,} scene Gaussians: what {config.memory:g} GiB take"
        yield Finding("most in a task", cap)
    for stage in estimate.stages:
        yield Finding(STAGES[stage.name], stage_line(stage))
    yield Finding("Gaussians, roughly", f"{estimate.coarse:,} after Stage I, sky included")
    yield Finding(f"{'GPU ' * cuda}memory of the job", f"about {gib(estimate.memory)} for one task")
    yield Finding("disk of the job", f"about {gib(estimate.disk)} of {gib(preflight.free)} free here")
    yield Finding("time of the job", time_of(estimate.seconds))
    if preflight.problem:
        yield Finding("the job", "does not fit", ok=False, fatal=True, fix=preflight.problem)
