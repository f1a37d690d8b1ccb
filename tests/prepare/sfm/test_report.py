"""What is reported of a reconstruction with faults."""

import json
from dataclasses import replace
from pathlib import Path

import cv2

from panolog.prepare.sfm.consistency.contradictions import Contradiction
from panolog.prepare.sfm.report import write_report
from tests.prepare.sfm.reports import faulty


def test_lines_say_what_is_wrong_and_where() -> None:
    lines = list(faulty().lines())
    assert lines[0].startswith("4 of 5 panoramas have a pose, 40 points, seen by 4.0 panoramas")
    assert lines[1] == "no pose: d.jpg (shares at most 17 features, with c.jpg)"
    assert "weak link: a.jpg to b.jpg holds 1 panoramas by 0 points" in lines[2]
    assert "may jump there by any factor" in lines[2]
    assert "weak link: c.jpg to e.jpg" in lines[3]
    assert "by 2.0%" in lines[3]
    assert "contradiction: b.jpg and e.jpg share 300 features, but 2 fit" in lines[4]
    assert lines[5].startswith("the world: z up")
    assert lines[6] == "the video ends early"


def test_json_and_plot_show_the_same(tmp_path: Path) -> None:
    write_report(tmp_path, faulty())
    read = json.loads((tmp_path / "sfm.json").read_text())
    missing = {"name": "d.jpg", "most_shared_with": "c.jpg", "matches": 17, "unconfirmed": False}
    assert read["missing"] == [missing]
    assert [link["scale_error"] for link in read["weak_links"]] == [None, 0.02]
    contradiction = {"between": ["b.jpg", "e.jpg"], "matches": 300, "points": 2}
    reason = "share 300 features, but 2 fit their poses"
    assert read["contradictions"] == [contradiction | {"reason": reason}]
    panorama = cv2.imread(str(tmp_path / "sfm.png"))
    assert panorama is not None
    red = (panorama[..., 2] > 150) & (panorama[..., 1] < 100) & (panorama[..., 0] < 60)
    assert red.sum() > 200  # the links, the pair and the panorama without a pose


def test_a_contradiction_of_two_that_fit_but_share_too_little_says_so() -> None:
    report = faulty()
    report = replace(report, found=replace(report.found, contradictions=[Contradiction((0, 2), 90, 90)]))
    (line,) = (line for line in report.lines() if line.startswith("contradiction"))
    assert "a.jpg and c.jpg share 90 features on one side alone, though they would stand close" in line


def test_a_panorama_that_shares_nothing_names_no_other() -> None:
    report = faulty()
    report = replace(report, found=replace(report.found, missing={3: (3, 0)}))
    assert "no pose: d.jpg (shares no features)" in list(report.lines())


def test_a_panorama_that_one_pair_alone_held_says_so() -> None:
    report = faulty()
    report = replace(report, found=replace(report.found, unconfirmed=frozenset({3})))
    line = list(report.lines())[1]
    assert line == (
        "no pose: d.jpg (shares at most 17 features, with c.jpg, and no second pair confirms what one says)"
    )


def test_another_part_is_named_once() -> None:
    report = faulty()
    report = replace(report, found=replace(report.found, others=[(3,)]))
    assert report.as_json()["parts"] == [["d.jpg"]]
    lines = list(report.lines())
    assert lines[1].startswith("another part: d.jpg to d.jpg, 1 panoramas that agree")
    assert not any(line.startswith("no pose") for line in lines)
