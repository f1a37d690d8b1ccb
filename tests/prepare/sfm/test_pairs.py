"""Which panoramas are matched, by descriptors in a database: nothing is rendered or matched."""

import cv2
import numpy as np
import pycolmap
import pytest

from panolog.prepare.panorama_files import PanoramaFile
from panolog.prepare.sfm.pairs import Pairing, choose_pairs
from panolog.prepare.sfm.workspace import Workspace, silence_colmap
from panolog.scene.write import no_progress

COUNT, TWIN = 60, (3, 44)  # panoramas, and two that show the same place, far apart in the order


@pytest.fixture(scope="module")
def work(tmp_path_factory: pytest.TempPathFactory) -> Workspace:
    folder = tmp_path_factory.mktemp("pairs")
    empty = bytes(cv2.imencode(".png", np.zeros((64, 128), np.uint8))[1])
    files = [folder / f"{row:03d}.png" for row in range(COUNT)]
    for file in files:
        file.write_bytes(empty)
    made = Workspace(folder / "work", tuple(PanoramaFile(folder, file.name, file) for file in files))
    made.open(None)
    pycolmap.Database.open(made.database).close()
    reader = pycolmap.ImageReaderOptions()
    reader.camera_model = "EQUIRECTANGULAR"
    pycolmap.import_images(
        made.database, made.images, pycolmap.CameraMode.SINGLE, made.numbers, options=reader
    )
    with pycolmap.Database.open(made.database) as database:
        for row, number in enumerate(made.ids()):
            own = np.random.default_rng(TWIN[0] if row == TWIN[1] else row)
            words = own.uniform(0, 1, (120, 128)) ** 4
            words = np.rint(512 * words / np.linalg.norm(words, axis=1, keepdims=True)).clip(0, 255)
            database.write_keypoints(number, own.uniform(0, 64, (120, 2)).astype(np.float32))
            kind = pycolmap.FeatureExtractorType.SIFT
            database.write_descriptors(number, pycolmap.FeatureDescriptors(kind, words.astype(np.uint8)))
    return made


@pytest.mark.parametrize("pairing", ["auto", "sequential"])
def test_neighbours_and_look_alikes_are_matched(pairing: Pairing, work: Workspace) -> None:
    with silence_colmap():
        chosen = choose_pairs(work, pairing, no_progress)
    ids = work.ids()
    assert {(ids[row], ids[row + 1]) for row in range(COUNT - 1)} <= set(chosen)
    assert (ids[TWIN[0]], ids[TWIN[1]]) in chosen
    assert len(chosen) == len(set(chosen)) < COUNT * (COUNT - 1) / 2
