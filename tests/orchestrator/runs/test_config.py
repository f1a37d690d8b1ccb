from pathlib import Path

import pytest
from pydantic import ValidationError

from panolog.orchestrator.runs.config import RESOLVED, RunConfig, change, known_settings, load_config
from panolog.scene.errors import InputError
from panolog.workers.training.recipes import RECIPES


def test_recipe_paper_has_the_papers_values() -> None:
    config = load_config(flags={"recipe": "paper"})
    assert (config.partition.rho_tri, config.partition.tau_grad, config.partition.aspect) == (5, 0.8, 0)
    assert (config.depth.unit, config.depth.sky, config.densify.prune_scale) == ("world", False, 0.1)
    assert (config.sky.kappa, config.sky.count) == (10, 100_000)
    assert (config.depth.w0, config.depth.wT) == (0.5, 0.01)
    assert (config.loss.lambda_ssim, config.iterations, config.blocks) == (0.2, 30_000, "2x1x1")


def test_flags_win_over_settings_and_settings_over_the_file(tmp_path: Path) -> None:
    file = tmp_path / "c.yaml"
    file.write_text("iterations: 10\nwidth: 64\nsky: {count: 5, kappa: 3}\n")
    config = load_config(file, ["iterations=20", "sky.count=1000"], {"iterations": 30, "blocks": None})
    assert (config.iterations, config.width) == (30, 64)
    assert (config.sky.count, config.sky.kappa, config.blocks) == (1000, 3, "2x1x1")


@pytest.mark.parametrize(
    ("setting", "says"),
    [
        ("sky.cout=3", "unknown setting sky.cout; did you mean sky.count?"),
        ("tau_grad=3", "unknown setting tau_grad; did you mean partition.tau_grad?"),
        ("qqqqqq=3", "the settings are exposure.*, movers.*, poses.*, near, "),
        ("=3", "write it as KEY=VALUE"),
        ("sky.count=many", 'setting sky.count = "many"'),
        ("sky.count=-1", "setting sky.count = -1"),
        ("blocks=0x1x1", 'setting blocks = "0x1x1": a block grid needs'),
        ("blocks=0", "0 blocks are not possible: give 1 to 16384"),
        ("blocks=2.5", "a block grid is written like 2x1x1"),
        ("blocks=many", "a block grid is written like 2x1x1"),
        ("width=33", "must be even"),
        ("iterations", "write it as KEY=VALUE"),
        ("iterations=[", "not YAML"),
        ("seed=2020-13-45", "not YAML"),
        ("loss=3", "setting loss = 3: keys with values are needed, such as loss."),
        ("depth=x", 'setting depth = "x": keys with values are needed, such as depth.'),
        ("iterations=1.5", "setting iterations = 1.5: a whole number is needed"),
        ("width=abc", 'setting width = "abc": a whole number is needed'),
        ("sky.count=-1", "setting sky.count = -1: it must be at least 0"),
        ("near=[1]", "setting near = [1]: a number is needed"),
        ("retention.models=maybe", 'setting retention.models = "maybe": true or false is needed'),
        ("device=tpu", 'setting device = "tpu"'),
        ("recipe=best", "setting recipe = \"best\": it must be 'paper', 'authors' or 'panolog'"),
        *((f"memory={text}", "setting memory = ") for text in ("0", "-1", "8MB", "much")),
    ],
)
def test_a_wrong_setting_is_one_clear_line(setting: str, says: str) -> None:
    with pytest.raises(InputError) as caught:
        load_config(None, [setting])
    assert says in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("setting", "blocks", "decided"),
    [("1", "1x1x1", True), ("08", "8", False), (" AUTO", "auto", False), ("3X2x1", "3x2x1", True)],
)
def test_blocks_are_a_grid_or_a_number(setting: str, blocks: str, decided: bool) -> None:
    for config in (load_config(None, [f"blocks={setting}"]), load_config(None, [], {"blocks": setting})):
        assert (config.blocks, config.decided) == (blocks, decided)
    if not decided:
        with pytest.raises(ValueError, match=f"blocks={blocks} are not decided yet"):
            _ = config.grid


def test_balanced_blocks_have_as_many_cuts_as_it_takes() -> None:
    config = load_config(None, ["blocks=3", "partition.cuts=[[x, 0.25, 1], [y, 0.5, 1]]"])
    assert config.decided
    assert config.grid.block_of([[0.1, 0.9, 0], [0.3, 0.4, 0], [0.3, 0.6, 0]]).tolist() == [0, 1, 2]
    assert not load_config(None, ["blocks=4", "partition.cuts=[[x, 0.25, 1], [y, 0.5, 1]]"]).decided
    with pytest.raises(InputError, match="the cut x = 2 with 1 of 2 blocks below has an empty side"):
        load_config(None, ["partition.cuts=[[x, 2, 1]]"])


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("- a list\n", "settings are lines such as"),
        ("a: [\n", "not YAML"),
        ("nope: 1\n", "unknown setting nope"),
        ("\x00", "not YAML"),
        ("seed: 2020-13-45\n", "not YAML"),
        (None, "cannot be read"),
    ],
)
def test_a_wrong_file_is_one_clear_line(tmp_path: Path, text: str | None, says: str) -> None:
    if text is not None:
        (tmp_path / "c.yaml").write_text(text)
    with pytest.raises(InputError, match=says) as caught:
        load_config(tmp_path / "c.yaml")
    assert "\n" not in str(caught.value)


def test_every_setting_explains_itself() -> None:
    assert not [name for name, field in known_settings() if not field.description]
    names = [name for name, _ in known_settings()]
    assert len(set(names)) == len(names)


def test_changes_are_checked_too() -> None:
    assert change(RunConfig(), {"partition.tau_grad": 0.7, "blocks": None}).partition.tau_grad == 0.7
    with pytest.raises(InputError, match="tau_grad"):
        change(RunConfig(), {"partition.tau_grad": 2.0})


def test_a_recipe_is_a_preset_of_what_is_not_given() -> None:
    preset = RECIPES["panolog"]
    config = load_config(flags={"recipe": "panolog"})
    tree = config.model_dump()
    for key, value in preset.items():
        group, _, name = key.rpartition(".")
        assert (tree[group] if group else tree)[name] == value
    assert load_config(sets=["recipe=panolog", "partition.tau_grad=0.7"]).partition.tau_grad == 0.7
    assert config == load_config() == RunConfig() != load_config(flags={"recipe": "paper"})
    assert RunConfig.model_validate(tree) == config


def test_the_settings_of_a_run_are_complete() -> None:
    run = {"recipe": "panolog", "partition": {"rho_tri": 5.0}}  # of a version whose recipe had no tau_grad
    assert RunConfig.model_validate(run, context=RESOLVED).partition.tau_grad == 0.8
    older = RunConfig.model_validate({"partition": {"rho_tri": 5.0}}, context=RESOLVED)  # knew no recipes
    assert older.recipe == "paper" and older.overlap is None
    assert (older.partition.aspect, older.depth.unit, older.depth.sky) == (0.5, "baseline", True)
    assert older.densify.prune_scale == 0
    gone = {"pyramid": {"steps": []}, "densify": {"scale_decay": 0.0, "large": "extent", "until": 7}}
    assert RunConfig.model_validate(gone, context=RESOLVED).densify.until == 7
    with pytest.raises(ValidationError, match="pyramid"):  # it would continue otherwise than it began
        RunConfig.model_validate({"pyramid": {"steps": [0.5]}}, context=RESOLVED)


@pytest.mark.parametrize(
    ("given", "means"),
    [
        ({"partition": {"exterior": "baked"}}, "baked"),
        ({"stage2": {"exterior": "train"}}, "full"),
        ({"stage2": {"exterior": "fixed"}}, "frozen"),
    ],
)
def test_former_names_remain_valid(given: dict[str, dict[str, str]], means: str) -> None:
    """Of settings, and of the run.json of an older run."""
    for context in (None, RESOLVED):
        assert RunConfig.model_validate(given, context=context).stage2.exterior == means
    (group, setting), *_ = given.items()
    ((key, value),) = setting.items()
    assert load_config(sets=[f"{group}.{key}={value}"]).stage2.exterior == means


@pytest.mark.parametrize("given", ["8", "8GiB", " 8.0 GiB", 8])
def test_memory_is_in_gib(given: object) -> None:
    assert load_config(flags={"memory": given}).memory == 8
    assert load_config().memory is None
