"""Runs what is missing: each variant of each scene once, with Stage I and scores of another where equal.

A result is of the settings and the code that are stored with it. One of other settings is refused; one of
other code is used, and its row says so. An unfinished run of other settings or other code begins anew.
"""

import json
import sys
import time
from collections.abc import Container, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from shutil import rmtree
from typing import Any

import numpy as np

from benchmarks import runs
from benchmarks.paper import results, snapshots
from benchmarks.paper.code import Code, present
from benchmarks.paper.measure import Gallery
from benchmarks.paper.results import Point, Result
from benchmarks.paper.tables import overlap_of
from benchmarks.paper.variants import (
    Measured,
    Settings,
    Variant,
    deciding,
    differing,
    differs_in_plan_alone,
    flat,
    same_scores,
    same_stage_one,
    same_training,
)
from benchmarks.report import machine, sentence
from panolog.orchestrator.cli.commands.api import resume, run
from panolog.orchestrator.cli.commands.evaluate import evaluate_run
from panolog.orchestrator.cli.commands.repartition import repartition
from panolog.orchestrator.runs.config import AUTO, RunConfig
from panolog.orchestrator.runs.folder import RunFolder, write_json
from panolog.orchestrator.runs.machines.machine import cores
from panolog.orchestrator.runs.records import ModelSaved, Progressed, RunBegan, Stored
from panolog.orchestrator.runs.state import replay
from panolog.partition.cells import Grid
from panolog.partition.plan import Plan, read_plan
from panolog.scene.errors import ConfigError, InputError, RunError
from panolog.scene.gaussians import Gaussians
from panolog.scene.ply import read_ply
from panolog.workers.tasks import Stage, TaskId
from panolog.workers.training.schedule import Schedule

_OFF = 0.05  # of the seconds that a run was given, from which on its row says what it took


@dataclass(frozen=True)
class Done:
    """A variant that has ended, with what decides whether another may share it."""

    config: dict[str, Any]
    result: Result
    root: Path  # of the run; that of another variant if it has not run itself


class Bench:
    """The variants of one scene with one seed, in one folder."""

    def __init__(
        self, folder: Path, scene: Path, seed: int, settings: Settings, code: Code | None = None
    ) -> None:
        self.folder = folder / scene.name
        self.scene = scene
        self.seed = seed
        self.settings = settings.of(scene)
        self.code = code or present()
        self.done: dict[str, Done] = {}

    def check(self, variants: Iterable[Variant]) -> None:
        """Raises InputError if a variant has a result of other settings, before anything runs."""
        for variant in variants:
            if variant.iterations is None:
                self._known(variant, variant.config(self.settings, self.seed, self.settings.iterations))

    def result(self, variant: Variant) -> Result:
        """The result of a variant, which runs if it has none yet."""
        missing = [name for name in variant.needs if name not in self.done]
        if missing:
            return self._failed(variant, f"it depends on {missing[0]}, which has no result")
        length = variant.length(self.settings, self.measured)
        try:
            config = variant.config(self.settings, self.seed, length)
            known = self._known(variant, config)
            result = known or self._new(variant, config, length)
        except (RunError, ConfigError) as error:  # the latter: a switch that needs others
            return self._failed(variant, str(error))
        if known is None:
            result = replace(result, notes=(*result.notes, *self.off(variant, result)))
            results.save(self._file(variant), result)
        root = self.done[result.same_as].root if result.same_as else self._root(variant)
        self.done[variant.name] = Done(complete(result.settings), result, root)
        return result

    def known(self, variant: Variant) -> bool:
        """Whether it has a result from before."""
        return self._file(variant).exists()

    def _known(self, variant: Variant, config: dict[str, Any]) -> Result | None:
        """The stored result, if there is one. Raises InputError if it is of other settings."""
        path = self._file(variant)
        found = results.load(path)
        if found is None:
            return None
        if changes := other_settings(found.settings, config):
            raise InputError(
                f"{path}: the result of {variant.name} has {changes}, as it would not run now;"
                " take another folder, or remove that file"
            )
        if found.sources != self.code.sources:
            name = found.code or "unknown code"
            print(f"paper: {path}: measured at {name}; now it is {self.code.name}", file=sys.stderr)
        return found

    @property
    def measured(self) -> Measured:
        """What there is so far."""
        return {name: done.result for name, done in self.done.items()}

    def off(self, variant: Variant, result: Result) -> Iterable[str]:
        """How far a run that was given the time of another has missed it, where that is much."""
        if variant.aim is None:
            return
        ratio = result.total / variant.aim(self.measured)
        print(f"paper: {variant.name}: {100 * ratio:.1f} % of the seconds it was given", file=sys.stderr)
        if abs(ratio - 1) > _OFF:
            yield f"took {100 * ratio:.0f} % of the seconds it was given"

    def _failed(self, variant: Variant, why: str) -> Result:
        return Result(self.scene.name, variant.name, self.seed, failed=why)

    def _root(self, variant: Variant) -> Path:
        return self.folder / f"{variant.name.replace(' ', '-')}@{self.seed}"

    def _file(self, variant: Variant, suffix: str = ".json") -> Path:
        """Next to its run; names of variants may have points, so that `with_suffix` would cut them."""
        return self._root(variant).with_name(f"{self._root(variant).name}{suffix}")

    def _new(self, variant: Variant, config: dict[str, Any], length: int) -> Result:
        if same := self._same(config):
            return replace(
                same.result, variant=variant.name, same_as=same.result.model, notes=(), settings=config
            )
        donor = self._donor(config)
        root, kept = self._root(variant), self._file(variant, ".states")
        watched = variant.curve and self.seed == 0
        self.begin(variant, config)
        if donor is not None and not RunFolder(root).info.exists():
            changes = differing(donor.config, config)
            scored = config["refine"] and _scored(donor.root) and same_scores(donor.config, config)
            runs.borrow_stage_one(donor.root, root, changes, scores=scored)
        with snapshots.kept(root, kept, wanted=watched):
            self._train(variant.resolved(self.settings, self.seed, length), root)
        gallery = Gallery.of(root, self.settings.device) if watched else None
        found = self._read(variant, length, donor, gallery, kept)
        changed = ("the sources changed while it ran",) if present() != self.code else ()
        notes, code, here = (*found.notes, *changed), self.code, sentence(machine())
        return replace(
            found, notes=notes, settings=config, sources=code.sources, code=code.name, machine=here
        )

    def _train(self, config: RunConfig, root: Path) -> None:
        """Runs or resumes it to its end. Raises RunError also where it is refused, such as for its memory."""
        try:
            with runs.one_at_a_time(root) as pool:
                if RunFolder(root).info.exists():
                    resume(root, pool=pool)
                else:
                    run(self.scene, root, config, pool=pool)
        except InputError as error:
            raise RunError(str(error)) from error

    def begin(self, variant: Variant, config: dict[str, Any]) -> None:
        """Removes what is there of a run of other settings or other code."""
        begun, wanted = self._file(variant, ".begun"), {"sources": self.code.sources, "settings": config}
        if not begun.exists() or json.loads(begun.read_bytes()) != wanted:
            for folder in (self._root(variant), self._file(variant, ".states")):
                if folder.exists():
                    print(f"paper: {folder} is of other settings or code: it begins anew", file=sys.stderr)
                    rmtree(folder)
            begun.parent.mkdir(parents=True, exist_ok=True)
            write_json(begun, wanted)

    def _same(self, config: dict[str, Any]) -> Done | None:
        """A variant whose model has the same bytes: equal settings, or equal plans from the same scores."""
        for done in self.done.values():
            if same_training(done.config, config):
                return done
        for done in self.done.values():
            sharing = differs_in_plan_alone(done.config, config) and same_scores(done.config, config)
            if sharing and RunFolder(done.root).plan.exists():
                plan = read_plan(RunFolder(done.root).plan)
                changes = {
                    key: value
                    for key, value in differing(done.config, config).items()
                    if key.startswith("partition.")
                }
                other = repartition(done.root, changes, None, device="cpu", progress=lambda *_: None).plan
                if equal_plans(plan, other):
                    return done
        return None

    def _donor(self, config: dict[str, Any]) -> Done | None:
        """A variant with the same Stage I, if possible one with the same scores."""
        able = [done for done in self.done.values() if same_stage_one(done.config, config)]
        scored = [d for d in able if same_scores(d.config, config) and _scored(d.root)]
        return next(iter(scored or able), None)

    def _read(
        self, variant: Variant, length: int, donor: Done | None, gallery: Gallery | None, kept: Path
    ) -> Result:
        """The result of a run that has ended."""
        root = self._root(variant)
        records = runs.history(root)
        device = self.settings.device
        evaluation = evaluate_run(root, model=None, crop_bottom=None, device=device, progress=lambda *_: None)
        seconds, notes = runs.stage_seconds(records, start=False), []
        borrowed = _borrowed(root, seconds, donor)
        peaks = [peak_of(records)]
        points: tuple[Point, ...] = ()
        if borrowed and donor is not None:
            notes.append(f"Stage I of {donor.result.variant}")
            peaks.append(donor.result.memory)
            points = tuple(point for point in donor.result.curve if point.stage == "coarse")
        if (drivers := sum(isinstance(item.record, RunBegan) for item in records)) > 1:
            notes.append(f"resumed ({drivers - 1}): work done twice counts twice")
        plan = read_plan(RunFolder(root).plan) if RunFolder(root).plan.exists() else None
        overlap, added = overlap_of(plan.assignment) if plan else (None, None)
        model = read_ply(RunFolder(root).point_cloud)
        means = {name: evaluation["mean"].get(name) for name in results.METRICS}
        densified, resets = turns(variant.resolved(self.settings, self.seed, length))
        result = Result(
            self.scene.name,
            variant.name,
            self.seed,
            iterations=length,
            densified=densified,
            resets=resets,
            blocks=sum(block.train for block in replay(records).plan or ()),
            metrics=means | _closer(root, model, device),
            gaussians=evaluation["gaussians"],
            bytes=evaluation["bytes"],
            seconds=seconds | borrowed,
            longest=_longest(records),
            threads=cores(),
            memory=max((peak for peak in peaks if peak is not None), default=None),
            overlap=overlap,
            added=added,
            notes=tuple(notes),
        )
        if gallery is None:
            return result
        points += snapshots.curve(root, kept, gallery, sum(borrowed.values()))
        last = Point(result.total, result.metrics["ws_psnr"] or 0.0, "merged")
        return replace(result, curve=(*points, last))


def _closer(root: Path, model: Gaussians, device: str) -> dict[str, float | None]:
    """The quality of a run's model at twice the width of training, where the panoramas have that."""
    gallery = Gallery.of(root, device)
    if gallery.scene.width < 2 * gallery.width:
        return {}
    twice = replace(gallery, width=2 * gallery.width)
    return {"twice_ws_psnr": twice.quality(model)["ws_psnr"]}


@dataclass
class Clock:
    """How long what remains will take, from what has been run: in units of one iteration of one task."""

    seconds: float = 0.0
    units: float = 0.0

    def took(self, seconds: float, units: float) -> None:
        """A variant has run."""
        self.seconds += seconds
        self.units += units

    def left(self, units: float) -> str:
        """For people."""
        if not self.units:
            return "time left not known yet"
        minutes = self.seconds / self.units * units / 60
        return f"about {minutes:.0f} min left" if minutes >= 1 else "less than a minute left"


def run_all(
    benches: Sequence[Bench], stages: Sequence[Sequence[Variant]], only: Container[str] | None = None
) -> Iterable[Result]:
    """The results of all variants of all scenes and seeds.

    Stage by stage, each over all scenes; later seeds of what has a spread come last. So what is there after
    an early end is what matters most. Args: only, variants that may run; of others only results are shown.
    """
    first, later = ([b for b in benches if (b.seed == 0) == own] for own in (True, False))
    work = [(b, v) for stage in stages for b in first for v in stage]
    work += [
        (b, v) for b in sorted(later, key=lambda b: b.seed) for stage in stages for v in stage if v.spread
    ]
    work = [(b, v) for b, v in work if only is None or v.name in only or b.known(v)]
    timer = Clock()
    for number, (bench, variant) in enumerate(work):
        if bench.known(variant):
            result = bench.result(variant)
        else:
            units = _units(bench, variant)
            left = sum(_units(b, v) for b, v in work[number:] if not b.known(v))
            where = f"{bench.scene.name}, {variant.name}, seed {bench.seed}"
            print(f"paper: {number + 1} of {len(work)}: {where}; {timer.left(left)}", file=sys.stderr)
            began = time.monotonic()
            result = bench.result(variant)
            timer.took(time.monotonic() - began, units)
        if result.failed:
            print(f"paper: {variant.name}: {result.failed}", file=sys.stderr)
        yield result


def _units(bench: Bench, variant: Variant) -> float:
    """Iterations that a variant trains, roughly: what it shares with one that has not run yet counts too."""
    ready = all(name in bench.done for name in variant.needs)
    length = (
        variant.length(bench.settings, bench.measured) if ready else variant.guess * bench.settings.iterations
    )
    try:
        config = variant.config(bench.settings, bench.seed, round(length))
    except ConfigError:
        return 0.0
    shared = any(same_stage_one(done.config, config) for done in bench.done.values())
    blocks = _count(config["blocks"]) if config["refine"] else 0
    return float(length * (blocks + (not shared)))


def _count(blocks: str) -> int:
    """How many there are; two where that is chosen later."""
    if blocks == AUTO:
        return 2
    return int(blocks) if blocks.isdecimal() else Grid.parse(blocks).count


def other_settings(stored: dict[str, Any], config: dict[str, Any]) -> str:
    """Settings of a stored result that would be others now and change its model; empty if there are none."""
    if not stored:
        return "settings that are not stored with it"
    then = complete(stored)
    changes = [f"{key} = {then.get(key)}, not {value}" for key, value in deciding(then, config).items()]
    return ", ".join(changes)


def complete(stored: dict[str, Any]) -> dict[str, Any]:
    """Stored settings, with the defaults of those that have come since then."""
    return flat(RunConfig(recipe="paper")) | stored


def turns(config: RunConfig) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """How often a run densifies, and how often it resets: in Stage I and, if it refines, in each block."""
    stages = [Schedule(config, config.iterations, 1.0, bool(refine)) for refine in range(1 + config.refine)]
    densified = tuple(sum(map(stage.densifies, stage.turns())) for stage in stages)
    return densified, tuple(sum(map(stage.resets, stage.turns())) for stage in stages)


def equal_plans(a: Plan, b: Plan) -> bool:
    """Whether both train the same cameras in the same cells."""
    same = a.grid == b.grid and np.array_equal(a.aabb.lower, b.aabb.lower)
    same = same and np.array_equal(a.aabb.upper, b.aabb.upper)
    return bool(same and (a.assignment.assigned != b.assignment.assigned).nnz == 0)


def peak_of(records: Sequence[Stored]) -> int | None:
    """Bytes: the largest peak of a process that trained, in the memory of its host."""
    found = [item.record for item in records if isinstance(item.record, Progressed)]
    peaks = [record.host_peak for record in found if record.host_peak is not None]
    return max(peaks, default=None)


def _borrowed(root: Path, seconds: dict[str, float], donor: Done | None) -> dict[str, float]:
    """Seconds by stage of what a run has from another. Raises RunError if it is not known from which."""
    stages = [str(Stage.COARSE), *([str(Stage.SCORE)] if _scored(root) else [])]
    missing = [stage for stage in stages if stage not in seconds]
    if missing and donor is None:
        raise RunError(f"{root} has Stage I from a run of another table: give that too in --tables")
    return {stage: donor.result.seconds[stage] for stage in missing} if donor else {}


def _longest(records: Sequence[Stored]) -> float:
    models = [item.record for item in records if isinstance(item.record, ModelSaved)]
    return max((model.seconds for model in models if model.task.stage is Stage.BLOCK), default=0.0)


def _scored(root: Path) -> bool:
    """Whether a run has scores."""
    return RunFolder(root).shard(TaskId.shard(0)).exists()
