"""What is reported of a reconstruction with faults."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from panolog.prepare.panorama_files import PanoramaFile
from panolog.prepare.sfm.consistency.contradictions import Contradiction
from panolog.prepare.sfm.links import Link
from panolog.prepare.sfm.reconstruct import Reconstruction
from panolog.prepare.sfm.report import SfmReport, write_report
from panolog.prepare.sfm.sparse_model import SparseModel
from panolog.prepare.world.georeference import georeference


@pytest.fixture
def report() -> SfmReport:
    """Four of five panoramas have a pose; two links are weak, one pair contradicts itself."""
    random = np.random.default_rng(0)
    rows = np.arange(40)
    model = SparseModel(
        rows=(0, 1, 2, 4),
        rotations=np.stack([np.eye(3)] * 4),
        translations=np.array([[0.0, 0, -z] for z in range(4)]),
        points=random.normal(0, 3, (40, 3)),
        sightings=tuple((rows, random.uniform(0, 1, (40, 2))) for _ in range(4)),
    )
    found = Reconstruction(
        panoramas=tuple(PanoramaFile(Path(), f"{name}.jpg", Path(f"{name}.jpg")) for name in "abcde"),
        layers={},
        size=(1024, 512),
        model=model,
        links=[
            Link((0, 1), (0,), 0, float("inf")),
            Link((2, 3), (3,), 9, 0.02),
            Link((1, 2), (0, 1), 90, 0.001),
        ],
        contradictions=[Contradiction((1, 4), 300, 2)],
        missing={3: (2, 17)},
        features=1000,
        pairs=10,
    )
    world = georeference(model.rotations, model.centers, [None] * 4, [None] * 4)
    return SfmReport(found, world, ("the video ends early",))


def test_lines_say_what_is_wrong_and_where(report: SfmReport) -> None:
    lines = list(report.lines())
    assert lines[0].startswith("4 of 5 panoramas have a pose, 40 points, seen by 4.0 panoramas")
    assert lines[1] == "no pose: d.jpg (shares at most 17 features, with c.jpg)"
    assert "weak link: a.jpg to b.jpg holds 1 panoramas by 0 points" in lines[2]
    assert "may jump there by any factor" in lines[2]
    assert "weak link: c.jpg to e.jpg" in lines[3]
    assert "by 2.0%" in lines[3]
    assert "contradiction: b.jpg and e.jpg share 300 features, but 2 fit" in lines[4]
    assert lines[5].startswith("the world: z up")
    assert lines[6] == "the video ends early"


def test_json_and_plot_show_the_same(report: SfmReport, tmp_path: Path) -> None:
    write_report(tmp_path, report)
    read = json.loads((tmp_path / "sfm.json").read_text())
    assert read["missing"] == [{"name": "d.jpg", "most_shared_with": "c.jpg", "matches": 17}]
    assert [link["scale_error"] for link in read["weak_links"]] == [None, 0.02]
    assert read["contradictions"] == [{"between": ["b.jpg", "e.jpg"], "matches": 300, "points": 2}]
    panorama = cv2.imread(str(tmp_path / "sfm.png"))
    assert panorama is not None
    red = (panorama[..., 2] > 150) & (panorama[..., 1] < 100) & (panorama[..., 0] < 60)
    assert red.sum() > 200  # the links, the pair and the panorama without a pose
