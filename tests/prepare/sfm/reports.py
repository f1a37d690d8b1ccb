"""A report of a reconstruction with faults."""

from pathlib import Path

import numpy as np

from panolog.prepare.panorama_files import PanoramaFile
from panolog.prepare.sfm.consistency.contradictions import Contradiction
from panolog.prepare.sfm.links import Link
from panolog.prepare.sfm.reconstruct import Reconstruction
from panolog.prepare.sfm.report import SfmReport
from panolog.prepare.sfm.sparse_model import SparseModel
from panolog.prepare.world.georeference import georeference


def in_a_row(rows: tuple[int, ...]) -> SparseModel:
    """Panoramas, one unit apart, that see the same 40 points anywhere."""
    random, points = np.random.default_rng(0), np.arange(40)
    return SparseModel(
        rows=rows,
        rotations=np.stack([np.eye(3)] * len(rows)),
        translations=np.array([[0.0, 0, -z] for z in range(len(rows))]),
        points=random.normal(0, 3, (40, 3)),
        sightings=tuple((points, random.uniform(0, 1, (40, 2))) for _ in rows),
    )


def faulty() -> SfmReport:
    """Four of five panoramas have a pose; two links are weak, one pair contradicts itself."""
    model = in_a_row((0, 1, 2, 4))
    found = Reconstruction(
        panoramas=tuple(PanoramaFile(Path(), f"{name}.jpg", Path(f"{name}.jpg")) for name in "abcde"),
        size=(1024, 512),
        model=model,
        links=[
            Link((0, 1), (0,), 0, float("inf")),
            Link((2, 3), (3,), 9, 0.02),
            Link((1, 2), (0, 1), 90, 0.001),
        ],
        contradictions=[Contradiction((1, 4), 300, 2)],
        missing={3: (2, 17)},
        unconfirmed=frozenset(),
        others=[],
        features=1000,
        pairs=10,
    )
    world = georeference(model.rotations, model.centers, [None] * 4, [None] * 4)
    return SfmReport(found, world, ("the video ends early",))
