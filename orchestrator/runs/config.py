"""The settings of a run: those of training, and what a whole run needs besides."""

import json
import math
from collections.abc import Iterator, Mapping, Sequence
from copy import deepcopy
from difflib import get_close_matches
from pathlib import Path
from typing import Any, Literal, cast

import yaml
from pydantic import BaseModel, Field, ValidationError, ValidationInfo, field_validator, model_validator
from pydantic.fields import FieldInfo

from panolog.orchestrator.runs.folder import flat
from panolog.orchestrator.runs.machines.config import DeadlinesConfig, QuarantineConfig, ScalingConfig
from panolog.partition.cells import MOST_BLOCKS, Cells, Cuts, Grid
from panolog.partition.plan import PartitionConfig
from panolog.scene.errors import ConfigError, in_one_line, wrong_value
from panolog.workers.settings import Group
from panolog.workers.tasks import Stage
from panolog.workers.training.config import TrainConfig
from panolog.workers.training.recipes import RECIPES, Recipe
from panolog.workers.training.schedule import FULL_RUN

AUTO = "auto"  # blocks that preflight chooses
RESOLVED = "resolved"  # context of validation: these are all settings of a run
_NOT_YAML = (yaml.YAMLError, ValueError)  # the latter for what looks like a date and is none


class EvalConfig(Group):
    """Metrics on the held-out panoramas, and the seams between blocks."""

    crop_bottom: float = Field(
        default=0.0,
        ge=0,
        lt=1,
        description="fraction of the image height, from the bottom, that takes no part; the paper crops 0.1"
        " where the camera was carried by hand",
    )
    seams: int = Field(
        default=64,
        ge=0,
        description="faces between blocks whose seams are measured at most, those near most cameras",
    )


class PassesConfig(Group):
    """Short trainings of the blocks' union, part by part, in which all that surrounds a part is refined."""

    round: float = Field(
        default=0.0,
        ge=0,
        le=1,
        description="part of `iterations` for which each block trains once more, among the others as they are"
        " by then; 0 = it does not, the paper",
    )
    repair: float = Field(
        default=0.0,
        ge=0,
        le=1,
        description="part of `iterations` for which what is near a face between two blocks then trains, on"
        " the panoramas of both, against a seam; 0 = it does not, the paper",
    )
    reach: float = Field(
        default=3.0, gt=0, description="median camera distances, b̂ of eq. 8, up to which that is near a face"
    )
    position: float = Field(default=0.1, gt=0, le=1, description="first rate of means over that of a block")
    rate: float = Field(default=0.25, gt=0, le=1, description="all other rates over those of a block")

    @property
    def stages(self) -> tuple[Stage, ...]:
        """The stages of the passes that there are, in order."""
        parts = {Stage.ROUND: self.round, Stage.REPAIR: self.repair}
        return tuple(stage for stage, part in parts.items() if part)


class RetentionConfig(Group):
    """What of a run stays on its disk once something newer stands for it."""

    checkpoints: int = Field(
        default=1,
        ge=1,
        le=100,
        description="checkpoints of a task that stay until it is done; an earlier one takes the place of the"
        " last if that is damaged when a run is resumed",
    )
    models: bool = Field(
        default=True, description="whether the models of blocks and other parts stay when the run is done"
    )


class DiskConfig(Group):
    """What a run does when its disk takes nothing more."""

    retry: float = Field(default=10.0, gt=0, description="seconds between two tries to write meanwhile")


_MEASURED = 1.0  # pixels: renders of a city were 87 to 101 dB from those of the whole model, with 2 71 to 78
# What runs did before there was a setting for it, by dotted key.
_FORMER: Mapping[str, Any] = {
    "recipe": "paper",
    "overlap": None,
    "partition.aspect": 0.5,
    "depth.unit": "baseline",
    "depth.sky": True,
    "densify.prune_scale": 0.0,
}
# Settings of older versions that no recipe used, as runs have them that did not either.
_WITHOUT_EFFECT: Mapping[str, Any] = {
    **{"densify.large": "extent", "densify.scale_decay": 0.0, "exposure.offset": False, "pyramid.steps": []},
    **{"depth.max_residual": 0.5, "depth.min_points": 20, "sky.train_scales": False, "stage2.reset": "all"},
}
_FORMER_EXTERIOR = {"train": "full", "fixed": "frozen"}  # of stage2.exterior


class RunConfig(TrainConfig):
    """All settings of a run. `run.json` keeps them as they were resolved."""

    recipe: Recipe = Field(
        default="panolog",
        description="preset of the settings that are not given: paper = as the paper has them, authors = as"
        " the authors' code has them, panolog = those that measured best (docs/quality.md)",
    )
    iterations: int = Field(
        default=30_000, ge=1, description="iterations of Stage I and of every block; app. A"
    )
    width: int | None = Field(
        default=None,
        ge=16,
        description="training width in pixels, twice the height; none = as the images are",
    )
    blocks: str = Field(
        default="2x1x1",
        description="blocks along x, y and z of the contracted cube, the paper has two; a number = so many"
        " balanced ones; auto = as many balanced ones as memory and machines need",
    )
    memory: float | None = Field(
        default=None,
        gt=0,
        description="GiB that a task may take of its GPU, or of its machine without one: what does not fit is"
        " divided by stage2.detail and districts, else Gaussians grow to what fits; none = all there is, and"
        " a job that does not fit is refused",
    )
    seed: int = Field(default=0, ge=0, lt=2**63, description="of all randomness")
    holdout: Literal["scene", "none"] = Field(
        default="scene", description="scene = its split, or else every 8th; none = all panoramas train"
    )
    device: Literal["auto", "cpu", "cuda"] = Field(
        default="auto", description="auto = CUDA if there is a GPU"
    )
    retries: int = Field(
        default=2, ge=0, description="repetitions of a task that failed, each from its last checkpoint"
    )
    preemptions: int = Field(
        default=-1,
        ge=-1,
        description="attempts of a task in a row, without a checkpoint, that may be lost with a machine that"
        " had announced that it leaves; -1 = any number; lost ones without announcement have a limit of five",
    )
    refine: bool = Field(
        default=True, description="false = Stage I alone, as it is; for comparison, the paper always refines"
    )
    districts: int = Field(
        default=1,
        ge=1,
        le=MOST_BLOCKS,
        description="parts of the place whose Stage I is trained apart, on the cameras in each and those"
        " within `overlap`, for places that are too large for one task",
    )
    overlap: float | None = Field(
        default=2.0,
        ge=0,
        description="median camera distances, b̂ of eq. 8, up to which a camera outside of a district trains"
        " it too; none = partition.rho_tri, which is no better but takes a quarter more memory",
    )
    deliver: bool = Field(
        default=True,
        description="whether a run ends with files for viewers: web/, sky.ply and georef.json",
    )
    partition: PartitionConfig = PartitionConfig()
    passes: PassesConfig = PassesConfig()
    eval: EvalConfig = EvalConfig()
    deadlines: DeadlinesConfig = DeadlinesConfig()
    quarantine: QuarantineConfig = QuarantineConfig()
    scaling: ScalingConfig = ScalingConfig()
    disk: DiskConfig = DiskConfig()
    retention: RetentionConfig = RetentionConfig()

    @model_validator(mode="before")
    @classmethod
    def _follow_recipe(cls, given: Any, info: ValidationInfo) -> Any:
        """Adds the settings of the recipe where none are given; those of a run are complete.

        A run of before there was a setting continues as it began.
        """
        if not isinstance(given, dict):
            return given
        given = _canonical(given)
        recipe = given.get("recipe", cls.model_fields["recipe"].default)
        known = isinstance(recipe, str) and recipe in RECIPES
        preset = RECIPES[cast(Recipe, recipe)] if known else {}
        for key, value in (_FORMER if info.context == RESOLVED else preset).items():
            if not _given(given, key):
                _put(given, key, value)
        return given

    @field_validator("memory", mode="before")
    @classmethod
    def _with_unit(cls, given: Any) -> Any:
        return given.strip().removesuffix("GiB") if isinstance(given, str) else given

    @field_validator("width")
    @classmethod
    def _even(cls, width: int | None) -> int | None:
        if width is not None and width % 2:
            raise ValueError("a panorama's width must be even")
        return width

    @field_validator("blocks", mode="before")
    @classmethod
    def _blocks(cls, given: Any) -> str:
        text = str(given).strip().lower()
        if text == AUTO:
            return AUTO
        if not text.isdecimal():
            return str(Grid.parse(text))
        if not 1 <= int(text) <= MOST_BLOCKS:
            raise ValueError(f"{text} blocks are not possible: give 1 to {MOST_BLOCKS}")
        return "1x1x1" if int(text) == 1 else str(int(text))

    @property
    def decided(self) -> bool:
        """Whether the cells of the blocks are known, as they are from the start of a run on."""
        return "x" in self.blocks or self.blocks == str(len(self.partition.cuts) + 1)

    def later(self, stage: Stage) -> "RunConfig":
        """The settings of the tasks of a pass: fewer iterations at low rates, no more Gaussians."""
        passes, stage2, optimizer = self.passes, self.stage2, self.optimizer
        part = passes.round if stage is Stage.ROUND else passes.repair
        iterations = max(1, round(part * self.iterations))
        first, rate = passes.position * stage2.position, passes.rate * stage2.rate
        update = {
            "iterations": iterations,
            "optimizer": optimizer.model_copy(update={"short_runs": self._short_runs(iterations)}),
            "densify": self.densify.model_copy(update={"until": 0}),
            "depth": self.depth.model_copy(update={"w0": min(self.depth.w0, self.depth.wT)}),
            "stage2": stage2.model_copy(update={"position": first, "rate": rate}),
        }
        return self.model_copy(update=update)

    def _short_runs(self, iterations: int) -> float:
        """The exponent by which a pass of so many iterations has the rates of a block's run."""
        length = [max(1.0, FULL_RUN / count) for count in (self.iterations, iterations)]
        return self.optimizer.short_runs * math.log(length[0]) / math.log(length[1]) if length[1] > 1 else 0.0

    @property
    def measured_detail(self) -> float | None:
        """Pixels: levels of detail that are evaluated, in shards; None = the model itself, as one task."""
        return min(self.stage2.detail, _MEASURED) if self.refine and self.stage2.reduces else None

    @property
    def grid(self) -> Cells:
        """The cells of the blocks. Raises ValueError where they are not decided yet."""
        if not self.decided:
            raise ValueError(f"the cells of blocks={self.blocks} are not decided yet")
        cells, cuts = self.partition.cells, self.partition.cuts
        return Grid.parse(self.blocks, cells) if "x" in self.blocks else Cuts(cuts)


def _canonical(given: dict[str, Any]) -> dict[str, Any]:
    """The given settings by the names that they have today."""
    tree = deepcopy(given)
    partition, stage2 = tree.get("partition"), tree.get("stage2")
    if isinstance(partition, dict) and "exterior" in partition:
        _put(tree, "stage2.exterior", partition.pop("exterior"))
    elif isinstance(stage2, dict) and stage2.get("exterior") in _FORMER_EXTERIOR:
        stage2["exterior"] = _FORMER_EXTERIOR[stage2["exterior"]]
    for key, without in _WITHOUT_EFFECT.items():
        group, name = key.split(".")
        settings = tree.get(group)
        if isinstance(settings, dict) and settings.get(name) == without:
            del settings[name]
            if not settings:
                del tree[group]
    return tree


def load_config(
    file: Path | None = None, sets: Sequence[str] = (), flags: Mapping[str, Any] | None = None
) -> RunConfig:
    """Settings from a YAML file, then `KEY=VALUE` settings, then explicit flags: the later wins.

    Args: file in YAML; sets like "sky.count=1000", the value in YAML; flags by dotted key, None = not given.
    Raises InputError that names the key and what is wrong with it.
    """
    tree = _read_yaml(file) if file is not None else {}
    for setting in sets:
        key, equals, value = setting.partition("=")
        if not (key.strip() and equals):
            raise ConfigError(f"--set {setting}: write it as KEY=VALUE, such as --set sky.count=20000")
        _put(tree, key.strip(), _parse_value(key, value))
    for key, value in (flags or {}).items():
        if value is not None:
            _put(tree, key, value)
    return validate(tree)


def change(config: RunConfig, flags: Mapping[str, Any]) -> RunConfig:
    """Other settings by dotted key, None = as it was. Raises InputError as `load_config`."""
    tree = config.model_dump()
    for key, value in flags.items():
        if value is not None:
            _put(tree, key, value)
    return validate(tree)


def validate(tree: Mapping[str, Any]) -> RunConfig:
    """Checked settings of a nested mapping. Raises InputError for the first thing that is wrong."""
    try:
        return RunConfig.model_validate(tree)
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(map(str, first["loc"]))
        if first["type"] == "extra_forbidden":
            raise ConfigError(f"unknown setting {key}{_nearest(key)}") from error
        given = json.dumps(first["input"], default=str, ensure_ascii=False)
        group = next((f", such as {name}" for name, _ in known_settings() if name.startswith(f"{key}.")), "")
        raise ConfigError(f"setting {key} = {given}: {wrong_value(first)}{group}") from error


def known_settings(model: type[BaseModel] = RunConfig, prefix: str = "") -> Iterator[tuple[str, FieldInfo]]:
    """All settings by their dotted keys."""
    for name, info in model.model_fields.items():
        if isinstance(kind := info.annotation, type) and issubclass(kind, BaseModel):
            yield from known_settings(kind, f"{prefix}{name}.")
        else:
            yield prefix + name, info


def _nearest(key: str) -> str:
    known = [name for name, _ in known_settings()]
    near = get_close_matches(key, known, n=1, cutoff=0.6)
    if not near:  # right name, wrong group
        near = [name for name in known if name.rpartition(".")[2] == key.rpartition(".")[2]]
    if near:
        return f"; did you mean {near[0]}?"
    groups = dict.fromkeys(
        f"{group}.*" if group else name for name in known for group in [name.rpartition(".")[0]]
    )
    return f"; the settings are {', '.join(groups)}"


def _read_yaml(file: Path) -> dict[str, Any]:
    try:
        tree = yaml.safe_load(file.read_text())
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "it is not UTF-8 text"
        raise ConfigError(f"{file}: cannot be read: {reason}") from error
    except _NOT_YAML as error:
        raise ConfigError(f"{file}: is not YAML: {in_one_line(error)}") from error
    if tree is None:
        return {}
    if not isinstance(tree, dict):
        raise ConfigError(f"{file}: settings are lines such as 'iterations: 3000'")
    return tree


def _parse_value(key: str, text: str) -> Any:
    try:
        return yaml.safe_load(text)
    except _NOT_YAML as error:
        raise ConfigError(f"--set {key}={text}: the value is not YAML") from error


def _put(tree: dict[str, Any], key: str, value: Any) -> None:
    *groups, name = key.split(".")
    for group in groups:
        child = tree.get(group)
        if not isinstance(child, dict):
            child = tree[group] = {}
        tree = child
    tree[name] = value


def _given(tree: Mapping[str, Any], key: str) -> bool:
    """Whether a dotted key has a value in a nested mapping, or its group one that is no mapping."""
    *groups, name = key.split(".")
    for group in groups:
        child = tree.get(group, {})
        if not isinstance(child, dict):
            return True
        tree = child
    return name in tree


def as_settings(config: RunConfig) -> list[str]:
    """What the user has set, as options `--set KEY=VALUE`; the rest is left to the defaults."""
    given = flat(config.model_dump(mode="json", exclude_unset=True))
    return [word for key, value in given for word in ("--set", f"{key}={json.dumps(value)}")]
