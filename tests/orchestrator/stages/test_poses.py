"""What a run writes of refined poses."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap
import pytest

from panolog.orchestrator.run.folder import RunFolder
from panolog.orchestrator.stages.scenes import learnt_scene, save_captured
from panolog.renderer.motion import moved
from panolog.scene.colmap import read_colmap
from panolog.scene.read import read_scene
from panolog.workers.capture.captured import Captured
from tests.scenes import write_scene


def test_poses_and_their_model_are_written(tmp_path: Path) -> None:
    scene = replace(read_scene(write_scene(tmp_path / "scene")), offset=(100.0, -20.0, 3.0))
    rows = np.array(scene.train)
    motion = np.array([0.02, 0, 0, 0, np.radians(0.5), 0])
    new = [moved(scene.panoramas[row].rotation, scene.panoramas[row].translation, motion) for row in rows]
    at_bound = np.arange(len(rows)) == 1
    captured = Captured(rows=rows, poses=np.stack([np.column_stack(pose) for pose in new]), at_bound=at_bound)
    folder = RunFolder(tmp_path / "run")
    folder.root.mkdir()
    save_captured(folder, captured, scene)

    table = json.loads(folder.poses.read_text())["panoramas"]
    assert [row["name"] for row in table] == [scene.panoramas[row].name for row in rows]
    assert [row["at_bound"] for row in table] == at_bound.tolist()
    assert table[0]["turned"] == pytest.approx(0.5)
    assert table[0]["pixels"] > 0 and table[0]["moved"] > 0
    loaded = pycolmap.Reconstruction(str(folder.sparse))
    assert loaded.num_images() == len(scene.panoramas)
    model = {image.name: image for image in read_colmap(folder.sparse).images}
    for row, (rotation, translation) in zip(rows, new, strict=True):
        image = model[scene.panoramas[row].name]
        assert image.rotation == pytest.approx(rotation)
        assert image.translation == pytest.approx(translation - rotation @ np.array(scene.offset))
        assert len(image.points) == len(scene.panoramas[row].observed)
    known = learnt_scene(folder, scene)
    assert known.panoramas[rows[0]].rotation == pytest.approx(new[0][0])
