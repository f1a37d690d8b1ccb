"""Which panoramas are matched, by descriptors in a database: nothing is rendered or matched."""

import numpy as np
import pycolmap
import pytest
from numpy.typing import NDArray

from panolog.prepare.sfm import looks
from panolog.prepare.sfm.looks import look_alikes
from panolog.prepare.sfm.pairs import Pairing, choose_pairs
from panolog.prepare.sfm.workspace import Workspace, silence_colmap
from panolog.scene.write import no_progress
from tests.prepare.sfm.consistency.simulated import database_of

COUNT, TWIN = 60, (3, 44)  # panoramas, and two that show the same place, far apart in the order
REPEATED, EMPTY = 10, 20  # one whose features are those of panorama 50, each twice; one that has a single one


@pytest.fixture(scope="module")
def work(tmp_path_factory: pytest.TempPathFactory) -> Workspace:
    random, words = np.random.default_rng(0), []
    for _ in range(COUNT):
        some = random.uniform(0, 1, (120, 128)) ** 4
        words.append(np.rint(512 * some / np.linalg.norm(some, axis=1, keepdims=True)).clip(0, 255))
    words[TWIN[1]] = np.clip(words[TWIN[0]] + random.integers(-6, 7, (120, 128)), 0, 255)
    words[REPEATED], words[EMPTY] = np.repeat(words[50], 2, axis=0), words[EMPTY][:1]
    keypoints = [random.uniform(0, 64, (len(it), 2)) for it in words]
    made = database_of(tmp_path_factory.mktemp("pairs"), keypoints)
    kind = pycolmap.FeatureExtractorType.SIFT
    with pycolmap.Database.open(made.database) as database:
        for number, it in zip(made.ids(), words, strict=True):
            database.write_descriptors(number, pycolmap.FeatureDescriptors(kind, it.astype(np.uint8)))
    return made


@pytest.mark.parametrize("pairing", ["auto", "sequential"])
def test_neighbours_and_look_alikes_are_matched(pairing: Pairing, work: Workspace) -> None:
    with silence_colmap():
        chosen = choose_pairs(work, pairing, no_progress)
    ids = work.ids()
    assert {(ids[row], ids[row + 1]) for row in range(COUNT - 1)} <= set(chosen)
    assert (ids[TWIN[0]], ids[TWIN[1]]) in chosen
    assert len(chosen) == len(set(chosen)) < COUNT * (COUNT - 1) / 2


def test_features_that_repeat_do_not_count(work: Workspace) -> None:
    found = look_alikes(work, 3, no_progress)
    assert TWIN in found
    assert (REPEATED, 50) not in found
    assert not any(EMPTY in pair for pair in found)


def test_many_are_compared_with_those_that_share_hashes(
    work: Workspace, monkeypatch: pytest.MonkeyPatch
) -> None:
    compared = list[int]()

    def counted(close: NDArray[np.float32]) -> int:
        compared.append(1)
        return matches_of(close)

    matches_of = looks._matches
    monkeypatch.setattr(looks, "_matches", counted)
    monkeypatch.setattr(looks, "_FEW", COUNT - 1)
    monkeypatch.setattr(looks, "_CANDIDATES", 6)
    found = look_alikes(work, 3, no_progress)
    assert TWIN in found and (REPEATED, 50) not in found
    assert len(compared) <= 6 * COUNT
