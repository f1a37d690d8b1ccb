"""Tables, goals and pages as functions of results."""

import csv
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.sparse import csr_array

from benchmarks.paper import goals, pages
from benchmarks.paper.reference import name_of
from benchmarks.paper.results import Point, Result, Results, load, save
from benchmarks.paper.runner import turns
from benchmarks.paper.study import Study
from benchmarks.paper.study import load as load_study
from benchmarks.paper.tables import HEAD, TAUS, Overlap, Table, main_tables, overlap_of, overlap_table
from benchmarks.paper.variants import Settings, variants
from benchmarks.report import markdown
from panolog.partition.assignment import Assignment
from panolog.scene.errors import InputError
from panolog.workers.training.recipes import RECIPES
from tests.benchmarks.paper.made import result

RUNS = (
    result("paper", 24.0),
    result("paper", 24.2, seed=1),
    result("panolog", 26.0),
    result("panolog", 26.4, seed=1),
    result("no-g2ps", 24.0, same_as="paper"),
    Result("street", "no-depth", 0, failed="out of memory"),
)


def study() -> Study:
    settings = Settings(512, 600, "2x1x1", "cpu", ())
    return Study(settings, ("main", "ablations"), ("street",), Results(RUNS), ())


def row(table: Table, name: str) -> dict[str, object]:
    (found,) = [row for row in table.rows if row[0] == name]
    return dict(zip(table.head, found, strict=True))


def test_rows_are_means_with_a_spread_over_seeds() -> None:
    main, _ = main_tables(Results(RUNS), ["main", "ablations"], [Path("street")])
    shown = row(main, "panolog")
    assert str(shown["WS-PSNR"]) == "26.20 ± 0.28"
    assert shown["gain dB"] == "+2.10 ± 0.14"  # paired by seed
    assert shown["iterations"] == "600 + 2 × 600"
    assert str(shown["minutes"]).startswith("1.667")  # 100 s, without evaluation
    assert str(shown["on workers"]).startswith("1.333")  # 80 s
    assert all(len(cells) == len(main.head) for cells in main.rows)
    assert set(HEAD) - set(main.head) == {"LPIPS", "LPIPS of 3DGS", "WS-PSNR 2×"}  # not measured


def test_equal_plans_and_failures_say_so() -> None:
    _, ablations = main_tables(Results(RUNS), ["main", "ablations"], [Path("street")])
    same = row(ablations, "no-g2ps")
    assert same["gain dB"] is None
    assert "same plan as paper, so the same model" in str(same["notes"])
    assert row(ablations, "no-depth")["notes"] == "failed: out of memory"
    assert row(ablations, "w/o G²PS [1]")["PSNR"] == 24.14  # of the paper's table


def test_a_row_that_has_not_run_has_a_gain_over_other_models() -> None:
    runs = [result("panolog-stage1", 24.0), result("blocks-2", 25.0, same_as="panolog")]
    (length,) = main_tables(Results(runs), ["length"], [Path("street")])
    assert row(length, "blocks-2")["gain dB"] == "+1.00"
    assert row(length, "panolog-stage1")["gain dB"] is None


def test_the_paper_is_shown_next_to_its_own_scenes() -> None:
    assert name_of(Path("/data/360Roam/room")) == "360roam"
    assert name_of(Path("/data/street")) == ""
    (main,) = main_tables(Results([result("paper", 24.0, scene="NSK")]), ["main"], [Path("Pano360/NSK")])
    assert row(main, "PanoLOG (paper) [1]")["MiB"] == 544.0
    assert row(main, "paper")["MiB"] == 5_000_000 / 2**20


def test_a_data_set_has_a_table_of_means_with_those_of_the_paper() -> None:
    scenes = [Path("Ricoh360/bricks"), Path("Ricoh360/bridge"), Path("street")]
    runs = [
        result("paper", 24.0, scene="bricks"),
        result("paper", 26.0, scene="bridge", gaussians=40_001, seconds={"coarse": 60.0}),
        result("panolog", 27.0, scene="bricks"),  # and not yet of the other one
        result("paper", 20.0),
    ]
    *each, mean = main_tables(Results(runs), ["main"], scenes)
    assert [table.title.split(": ")[1] for table in each] == ["bricks", "bridge", "street"]
    assert not any("[1]" in str(cells[0]) for table in each for cells in table.rows)
    shown = row(mean, "paper")
    assert (str(shown["WS-PSNR"]), shown["Gaussians"]) == ("25.00", 30_000)
    assert str(shown["minutes"]) == "1.333"  # 100 and 60 s
    assert "mean over 2 scenes" in str(shown["notes"])
    assert [cells[0] for cells in mean.rows if "[1]" not in str(cells[0])] == ["paper"]
    assert row(mean, "PanoLOG (paper) [1]")["PSNR"] == 26.48


def test_hand_held_scenes_of_the_paper_are_measured_without_their_bottom() -> None:
    given = Settings(512, 600, "2x1x1", "cpu", ("eval.crop_bottom=0.2",))
    alone = replace(given, sets=())
    for scene, settings, crop in (
        ("Pano360/BAX", alone, 0.1),
        ("Pano360/NSK", alone, 0.0),
        ("Pano360/BAX", given, 0.2),  # of the command
    ):
        assert variants()["paper"].config(settings.of(Path(scene)), 0, 600)["eval.crop_bottom"] == crop


def test_goals_are_met_or_missed() -> None:
    met = {goal.name: goal.met for goal in goals.goals(Results(RUNS), {})}
    assert met["panolog against paper, equal iterations: WS-PSNR"]
    assert not met["panolog against paper, equal iterations: SSIM"]  # equal
    runs = [
        result("blocks-2", 25.1),
        result("panolog-stage1", 25.0),
        result("stage1-all-2", 25.0),
        result("stage1-time-2", 24.5),
    ]
    _, *found = [(goal.measured, goal.met) for goal in goals.goals(Results(runs), {})]
    assert found == [("+0.10 dB", True), ("+0.10 dB", False), ("+0.60 dB", True)]
    for kind, met_there in (("flat", [True, True, True]), ("flight", [True, False, False])):
        assert [goal.met for goal in goals.goals(Results(runs), {"street": kind})][1:] == met_there


def test_blocks_with_one_budget_of_memory_each_are_compared_with_one_model() -> None:
    runs = [result("memory-1", 24.0), result("memory-2", 25.0), result("memory-8", 25.6)]
    (goal,) = goals.goals(Results(runs), {})
    assert (goal.measured, goal.met) == ("2 blocks +1.00 dB, 8 blocks +1.60 dB", True)


def test_stage_one_is_compared_with_itself_on_its_way() -> None:
    worse = (Point(50.0, 26.1, "coarse"), Point(100.0, 26.0, "coarse"))
    runs = [result("paper-stage1", 24.0), result("panolog-stage1", 26.0, curve=worse)]
    found = {goal.name: (goal.measured, goal.met) for goal in goals.goals(Results(runs), {})}
    assert found["street: Stage I of panolog at its end"] == ("26.00 dB, at most 26.10 dB before", False)
    gain = found["panolog-stage1 against paper-stage1, equal iterations: WS-PSNR"]
    assert gain == ("mean +2.00 dB: street +2.00", True)
    rising = result("panolog-stage1", 26.0, curve=worse[::-1])
    (last,) = [goal for goal in goals.goals(Results([rising]), {}) if "at its end" in goal.name]
    assert last.met


def test_the_time_to_the_quality_of_another_recipe_is_a_third_at_most() -> None:
    sooner = (Point(10.0, 23.0, "coarse"), Point(20.0, 25.0, "coarse"), Point(100.0, 26.0, "merged"))
    runs = [result("authors-stage1", 24.0), result("panolog-stage1", 26.0, curve=sooner)]
    name = "street: panolog-stage1 reaches the final WS-PSNR of authors-stage1 (24.00 dB)"
    for seconds, measured in ((40.0, "15 s of 40 s, 38 %"), (100.0, "15 s of 100 s, 15 %")):
        runs[0] = replace(runs[0], seconds={"coarse": seconds})
        found = {goal.name: (goal.measured, goal.met) for goal in goals.goals(Results(runs), {})}
        assert found[name] == (measured, seconds == 100.0)
    runs[0] = replace(runs[0], machine="another")  # its seconds are not those of this one
    assert name not in {goal.name for goal in goals.goals(Results(runs), {})}


def test_the_time_at_a_level_is_between_two_states() -> None:
    curve = (Point(10.0, 20.0, "coarse"), Point(20.0, 19.0, "coarse"), Point(30.0, 23.0, "merged"))
    assert goals.reached(curve, 21.0) == 25.0
    assert goals.reached(curve, 19.0) == 10.0
    assert goals.reached(curve, 24.0) is None


def test_results_survive_the_disk(tmp_path: Path) -> None:
    counted = replace(RUNS[0], densified=(28, 28), resets=(2, 2))
    save(tmp_path / "a.json", counted)
    assert (load(tmp_path / "a.json"), load(tmp_path / "b.json")) == (counted, None)
    study().save(tmp_path)
    assert load_study(tmp_path).results.all == list(RUNS)
    with pytest.raises(InputError, match="holds no results"):
        load_study(tmp_path / "none")


def test_a_study_is_written_as_text_and_sheet(tmp_path: Path) -> None:
    pages.write(tmp_path, study())
    text = (tmp_path / "report.md").read_text()
    assert "![quality-street](quality-street.svg)" in text
    with (tmp_path / "results.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [row["variant"] for row in rows] == [run.variant for run in RUNS]
    assert (rows[0]["ws_psnr"], rows[0]["total"], rows[-1]["failed"]) == ("24.0", "100.0", "out of memory")
    assert (tmp_path / "quality-street.svg").read_text().startswith("<svg")


def test_overlap_counts_what_gradients_add() -> None:
    gradient = csr_array([[True, True], [False, False], [True, False], [False, True]])
    assert overlap_of(Assignment(np.array([0, 1, 1, 1]), gradient)) == (6 / 4, 2 / 6)
    (cells,) = overlap_table([Overlap("street", "paper", tau, 1.5, 0.25) for tau in TAUS]).rows
    assert cells[:2] == ("street, paper", "1.50 (25 %)")


def test_markdown_keeps_columns_aligned() -> None:
    lines = markdown(["a", "b"], [[1234, 0.5], [None, 12345.6]]).splitlines()
    assert lines == ["| a     | b      |", "|-------|--------|", "| 1,234 | 0.5000 |", "| –     | 12,346 |"]


def test_the_page_of_the_documentation_has_measured_the_recipes_of_today() -> None:
    """Else `python -m benchmarks.paper` has to measure them again: the page says with which options."""
    path = Path(__file__).parents[3] / "docs" / "quality.md"
    found = pages.studies_of(path)
    pages.check_settings(found)
    assert {str(result.settings["recipe"]) for it in found for result in it.results.all} >= {*RECIPES}
    text = path.read_text()
    assert text.partition("\n")[0] == pages.FIRST_LINE
    assert all(f"\n## {it.title}\n\n    {it.command}\n" in text for it in found)


def test_a_page_has_no_results_of_other_recipes(tmp_path: Path) -> None:
    config = variants()["paper"].config(study().settings, 0, 600)
    older = result("paper", 24.0, settings=config | {"densify.gradient": 1e-4})
    with pytest.raises(
        InputError, match=r"paper of street in .* has densify.gradient = 0.0001, not 0.0002: "
    ):
        pages.write_docs(tmp_path / "quality.md", replace(study(), results=Results([older])))
    assert not list(tmp_path.iterdir())


def test_a_page_keeps_what_earlier_commands_have_measured(tmp_path: Path) -> None:
    page, settings = tmp_path / "quality.md", study().settings

    def measured(name: str, ws_psnr: float, machine: str, iterations: int = 600) -> Study:
        config = variants()[name].config(replace(settings, iterations=iterations), 0, iterations)
        found = result(name, ws_psnr, settings=config, machine=machine, iterations=iterations)
        given = replace(settings, iterations=iterations)
        return replace(study(), settings=given, chosen=("main",), results=Results((found,)))

    pages.write_docs(page, measured("paper", 24.0, "cpu A"))
    pages.write_docs(page, measured("panolog", 25.0, "cpu A", iterations=1500))
    assert page.read_text().count("On cpu A, code") == 2
    pages.write_docs(page, measured("panolog", 26.0, "cpu B"))
    short, _, long = page.read_text().partition("1,500 iterations")
    assert "| paper   | –" in short and "| panolog | +2.00" in short
    assert "Rows of 2 machines" in short and "; on cpu B" in short and "On cpu A" in long
    failed = replace(
        study(), chosen=("main",), results=Results([Result("street", "paper", 0, failed="full")])
    )
    pages.write_docs(page, failed)
    assert "| paper   | –" in page.read_text()
    pages.write_docs(page, measured("paper", 25.0, "cpu B"))  # anew
    assert "| panolog | +1.00" in page.read_text() and "cpu A" not in page.read_text().partition("1,500")[0]


def test_rows_say_how_often_a_run_densified_and_reset() -> None:
    settings = study().settings
    rows = {}
    for name in ("paper", "panolog", "paper-stage1"):
        densified, resets = turns(variants()[name].resolved(settings, 0, 30_000))
        blocks = 0 if "stage1" in name else 2
        found = result(name, 24.0, blocks=blocks, densified=densified, resets=resets)
        (shown,) = main_tables(Results([found]), ["stage1" if "stage1" in name else "main"], [Path("street")])
        rows[name] = tuple(row(shown, name)[key] for key in ("densified", "resets"))
    assert rows == {
        "paper": ("144 + 2 × 144", "4 + 2 × 4"),
        "panolog": ("234 + 2 × 234", "0 + 2 × 0"),
        "paper-stage1": ("144", "4"),
    }
    (main,) = main_tables(Results([result("paper", 24.0)]), ["main"], [Path("street")])
    assert row(main, "paper")["resets"] is None  # of a result of before it was recorded
