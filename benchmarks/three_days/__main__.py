"""Three simulated days of a run on 80 GPUs that fail: memory, descriptors, files, CPU and what was lost.

    python -m benchmarks.three_days [--hours 72] [--blocks 1000] [--machines 20] [--plot CURVES.svg] [--json]
    python -m benchmarks.three_days --quick

The real driver, database, journal, control channel and files; the machines are simulated
(`three_days/cluster.py`) on a clock that jumps, with the faults of `three_days/faults.py`. Drivers are killed
and resumed in processes of their own. Afterwards every message that a worker has delivered must be recorded
once and in order, every block must have one model, and the bounds of `three_days/checks.py` must hold.
"""

import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import asdict, replace
from multiprocessing import get_context
from pathlib import Path
from signal import SIGKILL

from benchmarks import report
from benchmarks.driver_scale.simulated_pool import grid
from benchmarks.driver_scale.status_requests import request_status
from benchmarks.runs import history
from benchmarks.three_days import faults, figures
from benchmarks.three_days.checks import Life, incomplete, read_sent, wrong
from benchmarks.three_days.curves import write_curves
from benchmarks.three_days.faults import Fault
from benchmarks.three_days.figures import FullRate
from benchmarks.three_days.life import STOPPED, Paths, live, read_samples
from benchmarks.three_days.load import GPUS, Load
from panolog.orchestrator.estimates.calibration import assumed
from panolog.orchestrator.run import folder as run_folder
from panolog.orchestrator.run import info
from panolog.orchestrator.run.config import PassesConfig, RunConfig
from panolog.orchestrator.run.folder import write_json
from panolog.orchestrator.run.info import SceneRef
from panolog.orchestrator.run.records import Progressed
from panolog.orchestrator.run.state import replay
from panolog.scene.errors import RunError
from panolog.scene.read import read_scene
from panolog.synthetic.make import make_town

EPOCH = 1.8e9  # the start of the run, seconds since 1970
RESUMED_S = 90.0  # after the end of a driver
TASK = 17 * faults.GIB  # bytes of a GPU that a block seems to need: one on each
MEMORY_DISK = Path("/dev/shm")  # the default: what a disk takes to flush is not simulated


def prepare(paths: Paths, load: Load) -> None:
    """A run that has not begun, of a town whose panoramas are never read."""
    scene = read_scene(make_town(paths.root / "town", panoramas=9, width=64, points=300))
    blocks, iterations, none = str(grid(load.blocks)), load.iterations, PassesConfig()
    config = RunConfig(width=64, device="cuda", blocks=blocks, iterations=iterations, passes=none)
    run_folder.make(paths.run.root)
    basis = assumed(scene, config)
    grown = replace(basis.measured.grown, device=TASK)
    basis = replace(basis, measured=replace(basis.measured, grown=grown))
    write_json(paths.run.preflight, {"basis": basis.as_json()})
    reference = SceneRef(path=str(scene.root), fingerprint=scene.fingerprint)
    info.write_info(paths.run, info.make_info(reference, config))


def simulate(paths: Paths, load: Load) -> list[Life]:
    """Runs drivers, one after the other, until the run has ended. Raises RunError if one fails."""
    lives: list[Life] = []
    now = 0.0
    while True:
        process = get_context("spawn").Process(target=live, args=(paths, load, EPOCH, now, len(lives)))
        process.start()
        process.join()
        code = process.exitcode or 0
        end = read_sent(paths)[-1].time
        lives.append(Life(now, end, killed=code == -SIGKILL))
        if code == 0:
            return lives
        if code not in (-SIGKILL, STOPPED):
            raise RunError(f"driver {len(lives)} ended with {code}")
        now = end + RESUMED_S


def full_rate(root: Path, load: Load) -> FullRate:
    """An hour or so of the same machines without faults, with as many messages as real workers send."""
    blocks, none = GPUS * load.machines, tuple(fault.value for fault in Fault)
    hours = min(1.0, load.hours / 60)
    load = replace(load, blocks=blocks, hours=hours, tick=1.0, progress=1.0, usage=10.0, without=none)
    paths = Paths(root)
    root.mkdir()
    prepare(paths, load)
    simulate(paths, load)
    rows = sum(isinstance(item.record, Progressed) for item in history(paths.run.root))
    first, *_, last = read_samples(paths)
    return FullRate(last.hours, last.messages, last.cpu - first.cpu, rows, last.database)


def measure(root: Path, load: Load, plot: Path | None) -> report.Report:
    """Simulates a run below `root`, and draws its curves to `plot`."""
    began = time.perf_counter()
    paths, plan = Paths(root), faults.draw(load)
    prepare(paths, load)
    lives = simulate(paths, load)
    seconds = time.perf_counter() - began
    sent, records, samples = read_sent(paths), history(paths.run.root), read_samples(paths)
    problems = [*wrong(sent, records, lives), *incomplete(paths, load, replay(records), records)]
    span = figures.makespan(load, plan, sent, records, lives)
    checked, met = figures.bounds(load, samples, span), figures.met(sent, plan, lives)
    full = full_rate(root / "full", load)
    status = request_status(paths.run.root)["command"]["longest"] / 1e3
    answer = figures.Bound("`panolog status`, seconds", status, 5, "a person waits for it", timed=True)
    checked += [full.bound, answer]
    title = f"{load.blocks:,} blocks on {GPUS * load.machines} GPUs, {samples[-1].hours:.1f} simulated hours"
    if plot is not None:
        write_curves(plot, samples, title)
    text = f"{title}, in {seconds:.0f} s\n\n{figures.table(span, checked, met)}\n\n"
    text += "\n".join(problems[:20]) or "nothing lost, nothing doubled"
    text += f"\n\n{full.sentence}"
    content = {
        "load": asdict(load),
        "full_rate": asdict(full),
        "seconds": seconds,
        "bounds": [asdict(bound) | {"met": bound.holds} for bound in checked],
        "makespan": asdict(span),
        "faults": met,
        "problems": problems,
        "samples": [asdict(sample) for sample in samples],
    }
    return report.Report(content, text, passed=not problems and all(bound.holds for bound in checked))


def _kinds(text: str) -> tuple[str, ...]:
    """The value of --without."""
    return tuple(Fault(name).value for name in text.split(","))


def main(arguments: Sequence[str] | None = None) -> int:
    """The program; returns its exit code: 1 if something was lost or doubled, or a bound is broken."""
    parser = report.parser("three_days", __doc__)
    parser.add_argument("--hours", type=float, default=72, help="simulated hours, roughly")
    parser.add_argument("--blocks", type=int, default=1000)
    parser.add_argument("--machines", type=int, default=20, help="of four GPUs each")
    parser.add_argument("--progress", type=float, default=60, help="simulated seconds between two messages")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument(
        "--without", type=_kinds, default=(), metavar="FAULT,...", help=f"none of these: {', '.join(Fault)}"
    )
    parser.add_argument("--folder", type=Path, help="where to write; by default in memory, /dev/shm")
    parser.add_argument("--plot", type=Path, metavar="FILE", help="the curves, as .svg or .png")
    options = parser.parse_args(arguments)
    if options.quick:
        options.blocks, options.machines, options.hours = 40, 5, 6.0
    load = Load(
        options.blocks,
        options.machines,
        options.hours,
        progress=options.progress,
        seed=options.seed,
        without=options.without,
    )

    def work() -> report.Report:
        folder = options.folder or (MEMORY_DISK if MEMORY_DISK.is_dir() else None)
        with tempfile.TemporaryDirectory(prefix="days-", dir=folder) as root:
            return measure(Path(root), load, options.plot)

    return report.run("three_days", options, work)


if __name__ == "__main__":
    sys.exit(main())
