"""What is run: variants of one training, each with the settings that it changes, and the tables they fill.

A variant whose iterations depend on what others have taken states these, so that they run before it.
"""

import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from benchmarks.paper.reference import CROPPED, name_of
from benchmarks.paper.results import Result
from panolog.orchestrator.runs.config import RunConfig, load_config
from panolog.orchestrator.runs.folder import flat as settings_in
from panolog.workers.training.recipes import RECIPES

Measured = Mapping[str, Result]  # by variant, of one scene and one seed
POINTS = 8  # states of a stage that a curve evaluates
BUDGET = 30_000  # scene Gaussians of a task, where memory is the limit
_GRIDS = {1: "1x1x1", 2: "2x1x1", 4: "2x2x1", 8: "4x2x1"}  # by the number of blocks
_SWITCHES = {  # settings of the panolog recipe that mean something only together
    "relocation": (
        *("densify.method", "densify.growth", "densify.long_runs", "densify.filled"),
        *("densify.weight", "densify.until"),
        *("densify.opacity_decay", "densify.noise", "densify.max_gaussians"),
    ),
    "block growth": ("stage2.growth", "stage2.opacity_decay"),
    "angle": ("densify.measure", "densify.views", "densify.long_axis"),
    "distance": ("optimizer.unit", "optimizer.least_pixels", "optimizer.largest"),
    "depth": ("depth.unit", "depth.sky", "depth.wT"),
}
_SECOND = ("recipe", "refine", "stage2.", "passes.", "checkpoint.", "preview.")  # after scores
_FREE = (*_SECOND, "blocks", "partition.")  # not in Stage I
_NO_SCORES = (*_SECOND, "partition.tau_grad")


@dataclass(frozen=True)
class Settings:
    """The settings of all variants; FOLDER/settings.json."""

    width: int  # pixels
    iterations: int  # of Stage I and of each block
    blocks: str
    device: str
    sets: tuple[str, ...]  # KEY=VALUE

    def of(self, scene: Path) -> "Settings":
        """These settings for one scene: the paper measures some scenes without the bottom of the image."""
        crop = CROPPED.get(name_of(scene))
        return replace(self, sets=(f"eval.crop_bottom={crop}", *self.sets)) if crop else self


@dataclass(frozen=True)
class Variant:
    """One way to train. Settings by dotted key win over those of the command line."""

    name: str
    what: str  # for the reader of a table
    settings: Mapping[str, Any]
    iterations: Callable[[int, Measured], int] | None = None  # of the command's and what has been measured
    needs: tuple[str, ...] = ()  # variants that `iterations` and `aim` read
    aim: Callable[[Measured], float] | None = None  # seconds for which `iterations` is meant
    guess: float = 1.0  # the same in iterations of the command, before anything is measured
    curve: bool = False  # its states on the way are evaluated
    spread: bool = False  # it is repeated for every seed
    usual: Mapping[str, Any] = field(default_factory=dict)  # settings over which those of a command win

    def length(self, settings: Settings, measured: Measured) -> int:
        """The iterations of Stage I and of each block."""
        if self.iterations is None:
            return settings.iterations
        return max(1, self.iterations(settings.iterations, measured))

    def sets(self, settings: Settings, seed: int, length: int) -> list[str]:
        """All settings that are not defaults, as KEY=VALUE; the later win."""
        base = {"width": settings.width, "blocks": settings.blocks, "device": settings.device, **self.usual}
        own = {"iterations": length, "seed": seed, **self.settings}
        saving = {"checkpoint.every": max(1, length // POINTS), "checkpoint.share": 1.0}
        return [
            *(f"{key}={json.dumps(value)}" for key, value in (base | saving).items()),
            *settings.sets,
            *(f"{key}={json.dumps(value)}" for key, value in own.items()),
        ]

    def resolved(self, settings: Settings, seed: int, length: int) -> RunConfig:
        """The settings of the run. Raises InputError for a wrong one."""
        return load_config(None, self.sets(settings, seed, length))

    def config(self, settings: Settings, seed: int, length: int) -> dict[str, Any]:
        """The same by dotted key."""
        return flat(self.resolved(settings, seed, length))


@dataclass(frozen=True)
class Group:
    """The variants of one table; the first is what the others are compared with."""

    name: str  # for --tables
    title: str
    variants: tuple[str, ...]
    note: str = ""
    source: str = ""  # the paper's table, if it has one


def flat(config: RunConfig) -> dict[str, Any]:
    """Settings by dotted key."""
    return dict(settings_in(config.model_dump(mode="json")))


def differing(a: Mapping[str, Any], b: Mapping[str, Any], without: Sequence[str] = ()) -> dict[str, Any]:
    """What `b` has otherwise than `a`, apart from keys that begin with one of `without`."""
    return {
        key: value for key, value in b.items() if a.get(key) != value and not key.startswith(tuple(without))
    }


def deciding(stored: Mapping[str, Any], config: Mapping[str, Any]) -> dict[str, Any]:
    """What a model of settings `config` would have otherwise than one of settings `stored`."""
    return differing(stored, config, ("preview.",) if config["refine"] else _FREE)


def same_stage_one(a: Mapping[str, Any], b: Mapping[str, Any]) -> bool:
    """Whether both train the same Stage I."""
    return not differing(a, b, _FREE)


def same_scores(a: Mapping[str, Any], b: Mapping[str, Any]) -> bool:
    """Whether both have the same Stage I and the same scores."""
    return not differing(a, b, _NO_SCORES)


def same_training(a: Mapping[str, Any], b: Mapping[str, Any]) -> bool:
    """Whether both end with the same bytes on a CPU."""
    return not differing(a, b, ("recipe", "checkpoint.", "preview."))


def differs_in_plan_alone(a: Mapping[str, Any], b: Mapping[str, Any]) -> bool:
    """Whether both have the same bytes if their plans are equal."""
    return not differing(a, b, ("recipe", "checkpoint.", "preview.", "partition."))


def variants() -> dict[str, Variant]:
    """All of them by name."""
    found = [*_recipes(), *_ablations(), *_blocks(), *_memory(), *_lengths(), *_switches()]
    return {variant.name: variant for variant in found}


def groups() -> tuple[Group, ...]:
    """The tables, the most important first: in this order they run and are shown."""
    switches = [variant.name for variant in _switches()]
    return (
        Group("main", "Recipe against recipe", ("paper", "authors", "panolog", "panolog-time")),
        Group(
            "stage1",
            "Stage I alone, over its iterations",
            ("paper-stage1", "authors-stage1", "panolog-stage1"),
        ),
        Group(
            "length",
            "Blocks against Stage I alone",
            (
                *("panolog-stage1", "blocks-2", "stage1-all-2", "stage1-time-2"),
                *("blocks-4", "stage1-all-4", "stage1-time-4"),
                *("paper-stage1", "paper", "authors-stage1", "authors"),
            ),
            note="`stage1-all` trains Stage I alone for as many iterations as Stage I and all blocks"
            " together, `stage1-time` for as long as Stage I, scoring and the longest block take on as many"
            " machines as blocks. That time is simulated: the sum of the stages with the longest block in"
            " place of all. Stage I and each block ran one after another, on the cores that a row names;"
            " other work on the machine is not excluded.",
        ),
        Group("g2ps", "G²PS against position alone", ("panolog-position", "panolog", "panolog-tau-0.8")),
        Group("switches", "Each switch of the panolog recipe", ("paper", *switches, "panolog")),
        Group(
            "ablations",
            "What each part of the method contributes",
            ("paper", "no-g2ps", "no-sky", "no-depth"),
            source="ablation",
        ),
        Group(
            "tau", "The threshold τ of eq. 11", ("paper", "tau-0.7", "tau-0.8", "tau-0.9"), source="threshold"
        ),
        Group("blocks", "Number of blocks", ("blocks-1", "blocks-2", "blocks-4", "blocks-8")),
        Group(
            "memory",
            "One budget of memory for every task",
            ("memory-1", *(f"memory-{count}" for count in _GRIDS if count > 1)),
            note=f"No task may have more than {BUDGET:,} Gaussians, or what the command sets, the sky not"
            " counted. `memory-1` is one model, for as many iterations as Stage I and four blocks together.",
        ),
    )


def stages(names: Iterable[str]) -> list[list[Variant]]:
    """The variants of these tables, table by table in the order of `groups`, each after those that it needs.

    One that several tables have is in the first of them.
    """
    known, chosen, tables = variants(), set(names), []
    seen: set[str] = set()

    def of(name: str) -> Iterable[Variant]:
        if name not in seen:
            seen.add(name)
            for needed in known[name].needs:
                yield from of(needed)
            yield known[name]

    for group in groups():
        if group.name in chosen:
            tables.append([variant for name in group.variants for variant in of(name)])
    return tables


def _recipes() -> list[Variant]:
    def time_of_paper(measured: Measured) -> float:
        return measured["paper"].total

    def in_time(_: int, measured: Measured) -> int:
        return measured["panolog"].iterations_in(time_of_paper(measured))

    return [
        Variant("paper", "the recipe of the paper", {"recipe": "paper"}, curve=True, spread=True),
        Variant("authors", "what the authors' release does", {"recipe": "authors"}, curve=True, spread=True),
        Variant("panolog", "the recipe of PanoLOG", {"recipe": "panolog"}, curve=True, spread=True),
        Variant(
            "panolog-time",
            "panolog for as long as paper takes",
            {"recipe": "panolog"},
            in_time,
            ("paper", "panolog"),
            time_of_paper,
            curve=True,
        ),
    ]


def _ablations() -> list[Variant]:
    paper = {"recipe": "paper"}
    return [
        Variant("no-g2ps", "paper, cameras by position alone", paper | {"partition.tau_grad": 1.0}),
        Variant("no-sky", "paper without sky sphere", paper | {"sky.count": 0}),
        Variant("no-depth", "paper without depth supervision", paper | {"depth.w0": 0.0}),
        *(
            Variant(f"tau-{tau}", f"paper with τ = {tau}", paper | {"partition.tau_grad": tau})
            for tau in (0.7, 0.8, 0.9)
        ),
        *(
            Variant(name, what, {"recipe": "panolog", "partition.tau_grad": tau}, spread=True)
            for name, what, tau in (
                ("panolog-position", "panolog, cameras by position alone", 1.0),
                ("panolog-tau-0.8", "panolog with τ = 0.8", 0.8),
            )
        ),
    ]


def _grid(count: int) -> dict[str, Any]:
    """So many blocks. Of four cells along an axis, the outer ones of the contracted cube hold no camera."""
    return {"blocks": _GRIDS[count]} | ({"partition.cells": "box"} if count > 4 else {})


def _blocks() -> list[Variant]:
    return [
        Variant(f"blocks-{count}", f"panolog in {grid}", {"recipe": "panolog", **_grid(count)})
        for count, grid in _GRIDS.items()
    ]


def _memory() -> list[Variant]:
    """Each task grows as far as its memory goes: one model has one budget, blocks have one each."""
    full, usual = {"recipe": "panolog", "densify.growth": 10.0}, {"densify.max_gaussians": BUDGET}

    def in_all(length: int, measured: Measured) -> int:
        return length * (1 + measured["memory-4"].blocks)

    alone = full | {"refine": False}
    return [
        *(
            Variant(f"memory-{count}", f"{count} blocks", full | _grid(count), usual=usual)
            for count in _GRIDS
            if count > 1
        ),
        Variant("memory-1", "one model", alone, in_all, ("memory-4",), guess=5.0, usual=usual),
    ]


def _lengths() -> list[Variant]:
    made = [
        Variant(
            f"{recipe}-stage1",
            f"Stage I of {recipe}, as blocks begin with it",
            {"recipe": recipe, "refine": False},
            curve=True,
            spread=True,
        )
        for recipe in RECIPES
    ]
    alone = {"recipe": "panolog", "refine": False}
    for count in (2, 4):
        blocks, whole = f"blocks-{count}", f"stage1-all-{count}"

        def in_all(length: int, measured: Measured, blocks: str = blocks) -> int:
            return length * (1 + measured[blocks].blocks)

        def on_workers(measured: Measured, blocks: str = blocks) -> float:
            return measured[blocks].on_workers

        def in_time(_: int, measured: Measured, blocks: str = blocks, whole: str = whole) -> int:
            return measured[whole].iterations_in(measured[blocks].on_workers)

        made += [
            Variant(
                whole,
                f"Stage I for the iterations of {blocks} in all",
                alone,
                in_all,
                (blocks,),
                guess=1.0 + count,
            ),
            Variant(
                f"stage1-time-{count}",
                f"Stage I for the time of {blocks} on {count} workers",
                alone,
                in_time,
                (blocks, whole),
                on_workers,
                guess=2.0,
            ),
        ]
    return made


def _switches() -> list[Variant]:
    defaults = flat(RunConfig(recipe="paper"))
    made = []
    recipe = RECIPES["panolog"]
    together = {name: [key for key in keys if key in recipe] for name, keys in _SWITCHES.items()}
    alone = [key for key in recipe if not any(key in keys for keys in together.values())]
    for name, keys in [*together.items(), *((key, [key]) for key in alone)]:
        if keys:
            on, off = ({key: values[key] for key in keys} for values in (recipe, defaults))
            made += [
                Variant(f"with {name}", f"paper and {_words(on)}", {"recipe": "paper", **on}),
                Variant(f"without {name}", f"panolog and {_words(off)}", {"recipe": "panolog", **off}),
            ]
    return made


def _words(settings: Mapping[str, Any]) -> str:
    return ", ".join(f"{key} = {value}" for key, value in settings.items())
