"""What is run, what it shares, and how long it trains."""

import pytest

from benchmarks.paper.results import Result
from benchmarks.paper.variants import (
    Settings,
    differing,
    differs_in_plan_alone,
    groups,
    same_scores,
    same_stage_one,
    same_training,
    stages,
    variants,
)
from panolog.workers.training.recipes import RECIPES
from tests.benchmarks.paper.made import result

SETTINGS = Settings(64, 600, "2x1x1", "cpu", ("sky.count=2000",))


def config(name: str, length: int = 600) -> dict[str, object]:
    return variants()[name].config(SETTINGS, 0, length)


@pytest.mark.parametrize("name", variants())
def test_every_variant_is_a_valid_run_and_overrides_the_user(name: str) -> None:
    found = config(name)
    for key, value in variants()[name].settings.items():
        assert found[key] == value
    assert found["sky.count"] == (0 if name == "no-sky" else variants()[name].settings.get("sky.count", 2000))
    assert found["checkpoint.every"] == 75  # eight states of each stage


def test_every_table_names_variants_that_exist() -> None:
    known = variants()
    for group in groups():
        assert all(name in known for name in group.variants)
    for how, own in (("with", "paper"), ("without", "panolog")):
        switches = [v for name, v in known.items() if name.startswith(f"{how} ")]
        keys = [key for variant in switches for key in variant.settings if key != "recipe"]
        assert sorted(keys) == sorted(RECIPES["panolog"])  # each setting in one switch
        assert {variant.settings["recipe"] for variant in switches} == {own}


def test_what_a_variant_needs_runs_before_it() -> None:
    ((*length,),) = stages(["length"])
    names = [variant.name for variant in length]
    assert names.index("blocks-4") < names.index("stage1-all-4") < names.index("stage1-time-4")
    assert [v.name for v in stages(["tau"])[0]] == ["paper", "tau-0.7", "tau-0.8", "tau-0.9"]
    both = stages(["tau", "main"])  # the most important table first, nothing twice
    assert [[v.name for v in stage] for stage in both] == [
        ["paper", "authors", "panolog", "panolog-time"],
        ["tau-0.7", "tau-0.8", "tau-0.9"],
    ]


@pytest.mark.parametrize(
    ("one", "other", "equal"),
    [
        ("paper", "tau-0.8", {"Stage I", "scores", "all but the plan", "training"}),
        ("panolog", "blocks-2", {"Stage I", "scores", "all but the plan", "training"}),
        ("paper", "tau-0.7", {"Stage I", "scores", "all but the plan"}),
        ("paper", "no-g2ps", {"Stage I", "scores", "all but the plan"}),
        ("paper", "paper-stage1", {"Stage I", "scores"}),
        ("paper", "with block growth", {"Stage I", "scores"}),
        ("panolog", "without block growth", {"Stage I", "scores"}),
        ("panolog", "blocks-4", {"Stage I"}),
        ("paper", "no-sky", set()),
        ("paper", "no-depth", set()),
    ],
)
def test_what_two_variants_share(one: str, other: str, equal: set[str]) -> None:
    relations = {
        "Stage I": same_stage_one,
        "scores": same_scores,
        "all but the plan": differs_in_plan_alone,
        "training": same_training,
    }
    found = {name for name, same in relations.items() if same(config(one), config(other))}
    assert found == equal


def test_a_longer_training_differs_from_its_first_iteration_on() -> None:
    assert not same_stage_one(config("paper"), config("paper", 700))
    assert differing(config("paper"), config("tau-0.7")) == {"partition.tau_grad": 0.7}


def test_stage_one_alone_trains_as_long_as_all_stages_together() -> None:
    known = variants()
    measured: dict[str, Result] = {"blocks-2": result("blocks-2", 25)}
    assert known["stage1-all-2"].length(SETTINGS, measured) == 600 * 3
    assert known["no-sky"].length(SETTINGS, measured) == 600
    alone = result("stage1-all-2", 25, iterations=1800, seconds={"coarse": 160.0, "merge": 2.0})
    measured["stage1-all-2"] = alone
    found = known["stage1-time-2"]
    assert found.length(SETTINGS, measured) == round(1800 * 78 / 160)  # 80 s on workers, 2 s of merge
    assert found.aim is not None
    assert found.aim(measured) == 80


def test_panolog_is_given_the_time_of_paper() -> None:
    measured = {
        "paper": result("paper", 24),
        "panolog": result("panolog", 25, seconds={"coarse": 30.0, "score": 10.0, "block": 15.0}),
    }
    assert variants()["panolog-time"].length(SETTINGS, measured) == 1200  # scores take no longer
